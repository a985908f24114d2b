"""What README says of workers is possible."""

import ast
import re
import shlex

from typer.main import get_command

from emt.cli.main import app
from emt.cluster.connecting import ADDRESS
from tests.test_documents import README, block


def test_the_commands_in_readme_are_possible():
    lines = [line for line in README.splitlines() if re.match("    emt run .*--(workers|scheduler)", line)]
    assert len(lines) == 3
    command = get_command(app).commands["run"]
    for line in lines:
        found = command.make_context("run", shlex.split(line, comments=True)[2:]).params
        assert found["config"] == "mine.yaml"
        assert (found["workers"] is None) != (found["scheduler"] is None)
        assert found["scheduler"] is None or ADDRESS.fullmatch(found["scheduler"])


def test_the_script_in_readme_is_python():
    assert ast.parse(block("python", "SLURMCluster"))
