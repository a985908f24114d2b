"""The command line, in this process or in one of its own."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from emt.cli.errors import run_app
from emt.cli.main import app


class Outcome(NamedTuple):
    """What a command did."""

    code: int
    out: str
    err: str


def emt(capsys, *arguments: str) -> Outcome:
    """A command run in this process."""
    capsys.readouterr()
    code = run_app(lambda **options: app([str(a) for a in arguments], **options), debug=False)
    printed = capsys.readouterr()
    return Outcome(code, printed.out, printed.err)


def start_emt(*arguments: str, cwd: Path, cache: Path) -> subprocess.Popen:
    """A command started in a process of its own."""
    code = "import sys; from emt.cli.main import main; sys.argv[0] = 'emt'; main()"
    environment = os.environ | {"EMT_CACHE": str(cache)}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
