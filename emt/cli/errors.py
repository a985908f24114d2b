"""Every failure as a message with a meaning: exit 1 ran and a check failed, exit 2 cannot run."""

import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import typer

from emt.config.warning import ConfigWarning

# typer carries its own copy of click, or uses an installed one, depending on its version
UsageError: type[Exception] = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")

CHECK_FAILED = 1
UNUSABLE = 2


class UnusableError(Exception):
    """Something the user must change before the command can run; the text says what and how."""


class InterruptedRunError(Exception):
    """Stopped by the user; the text says what is kept and how to go on."""


def say(message: str) -> None:
    """A message to the user, apart from results."""
    print(message, file=sys.stderr)


def expected_errors() -> tuple[type[Exception], ...]:
    """Errors whose text is written for users."""
    from emt.config.errors import ConfigError
    from emt.registry import PluginError, UnknownName
    from emt.store import StoreError

    found: list[type[Exception]] = [UnusableError, ConfigError, StoreError, PluginError, UnknownName]
    if "emt.conformance.golden" in sys.modules:
        from emt.conformance.golden import GoldenError

        found.append(GoldenError)
    return tuple(found)


def show_warning(message: Warning | str, category: type[Warning], *where: object) -> None:
    """A warning as a message to the user."""
    say(f"warning: {message}")


def run_app(app: Callable[..., object], debug: bool) -> int:
    """Runs the command line and turns whatever ends it into messages and an exit code."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", ConfigWarning)
        warnings.showwarning = show_warning
        return finished(app, debug)


def finished(app: Callable[..., object], debug: bool) -> int:
    """Exit code of the command line."""
    try:
        result = app(standalone_mode=False)
        return result if isinstance(result, int) else 0
    except typer.Exit as stop:
        return stop.exit_code
    except UsageError as error:
        error.show()  # type: ignore[attr-defined]
        return UNUSABLE
    except InterruptedRunError as error:
        say(str(error))
        return CHECK_FAILED
    except (KeyboardInterrupt, typer.Abort):
        say("interrupted")
        return CHECK_FAILED
    except BrokenPipeError:
        # the reader of our output, such as `head`, has seen enough
        sys.stderr.close()
        return 0
    except Exception as error:
        if debug:
            traceback.print_exc()
            return UNUSABLE
        if isinstance(error, expected_errors()):
            say(str(error))
        else:
            say(f"a fault in emt: {type(error).__name__}: {error}\nreport: {write_report()}; --debug shows it here")
        return UNUSABLE


def write_report() -> Path:
    """The current traceback in a file of its own; returns its path."""
    with tempfile.NamedTemporaryFile("w", prefix="emt-fault-", suffix=".txt", delete=False, encoding="utf-8") as file:
        file.write(f"command: {' '.join(sys.argv)}\n\n{traceback.format_exc()}")
    return Path(file.name)
