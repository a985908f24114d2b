"""The command line: `emt COMMAND --help` explains each command with an example."""

import sys
from typing import Annotated

import typer

from emt.cli import bench, checking, describing, reproducing, running, tuning
from emt.cli.errors import run_app

app = typer.Typer(
    name="emt",
    help="Batch Monte Carlo evaluation of extended-object trackers.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def show_version(wanted: bool) -> None:
    """Prints the version with those of JAX and its device, and ends."""
    if wanted:
        from emt.device import environment

        facts = environment()
        typer.echo(f"emt {facts['emt']}, jax {facts['jax']}, {facts['backend']} ({facts['device']})")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=show_version, is_eager=True, help="Show versions and device.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Options before the command."""


app.command("list")(describing.list_names)
app.command("show")(describing.show)
app.command("schema")(describing.schema)
app.command("run")(running.run)
app.command("reproduce")(reproducing.reproduce)
app.command("table")(running.table)
app.command("replay")(running.replay)
app.command("tune")(tuning.tune)
app.command("verify")(checking.verify)
app.command("check")(checking.check)
app.command("bench")(bench.bench)


def main() -> None:
    """Entry point of the `emt` command."""
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    sys.argv[1:] = arguments  # wherever it stands
    sys.exit(run_app(app, debug))
