"""`emt bench`: what emt costs, beside other ways to compute the same."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from emt.cli.errors import CHECK_FAILED, UnusableError, say

WHOLE = ("scaling", "reproduce")
"""Workloads that run commands; they take minutes and have to be named."""


def bench(
    workloads: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[WORKLOAD|CONFIG|PAPER]...", help="What to time; by default the six standard workloads."
        ),
    ] = None,
    peers: Annotated[bool, typer.Option("--peers", help="Also time filters of other, installed packages.")] = False,
    repetitions: Annotated[int, typer.Option(min=1, help="Interleaved repetitions; the median counts.")] = 7,
    runs: Annotated[
        str, typer.Option(metavar="N,N,...", help="Numbers of runs of `scaling`.")
    ] = "1000,10000,100000,1000000",
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything there.")] = None,
    report: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Write benchmark.md there.")] = None,
) -> None:
    """Time the standard workloads, each beside NumPy, plain JAX and other packages that compute the same.

    The workloads are vb, mem_ekf_star, moment_ukf, shape_mixture, multiple_model and particle; `scaling` runs one of
    them with up to a million runs, and `reproduce` is the whole of `emt reproduce`. These two take minutes and have to
    be named. Any other experiment, or paper, is timed part by part.

    Example: emt bench vb mem_ekf_star --peers --json bench.json
    """
    from emt.benchmark.clock import blas_on_one_thread

    blas_on_one_thread()  # before NumPy is loaded
    sizes = sizes_of(runs)
    standard, whole, experiments = sorted_out(workloads or [])
    for option, place in (("--json", json_file), ("--report", report)):
        check_place(option, place)
    results: dict[str, Any] = {"workloads": {}, "scaling": None, "reproduce": None, "parts": {}}
    results |= measure_workloads(results["workloads"], standard, repetitions, peers)
    measure_whole(results, whole, sizes)
    show(results, experiments, repetitions)
    if json_file is not None:
        write(json_file, json.dumps(results, indent=2, ensure_ascii=False) + "\n")
        say(f"measurements: {json_file}")
    if report is not None:
        from emt.benchmark.report import markdown

        write(report / "benchmark.md", markdown(results))
        say(f"report: {report / 'benchmark.md'}")


def sorted_out(names: list[str]) -> tuple[list[str], list[str], list[str]]:
    """Standard workloads, whole commands, and experiments among what is asked for.

    Raises:
        UnusableError: a name is none of them.
    """
    from emt.benchmark.standard import WORKLOADS
    from emt.config.shipped import config_names, papers
    from emt.registry import suggest

    known = [*WORKLOADS, *WHOLE]
    for name in names:
        if name in known or name in papers() or name in config_names() or is_file_name(name):
            continue
        near = suggest(name, [*known, *papers(), *config_names()])
        hint = f" (did you mean '{near}'?)" if near else ""
        raise UnusableError(f"unknown workload '{name}'{hint}; known: {', '.join(known)}, experiments and papers")
    names = list(dict.fromkeys(names))
    standard: list[str] = [name for name in WORKLOADS if not names or name in names]
    experiments = [name for name in names if name not in known]
    if standard and experiments:
        raise UnusableError(
            f"'{experiments[0]}' is timed on all processors and the workload '{standard[0]}' on one: "
            "give them to two commands"
        )
    return standard, [name for name in WHOLE if name in names], experiments


def is_file_name(name: str) -> bool:
    """Whether a text means a configuration file, which need not exist: reading it says what is wrong."""
    return Path(name).suffix in (".yaml", ".yml") or Path(name).exists()


def sizes_of(text: str) -> list[int]:
    """Numbers of runs, in the order given.

    Raises:
        UnusableError: not positive numbers.
    """
    try:
        sizes = [int(part) for part in text.split(",")]
    except ValueError:
        sizes = []
    if not sizes or min(sizes) < 1:
        raise UnusableError(f"--runs {text}: expected numbers of runs such as 1000,10000")
    return sizes


def check_place(option: str, place: Path | None) -> None:
    """Makes sure that results can be written before they are measured; makes the folder of a report.

    Raises:
        UnusableError: they cannot.
    """
    import os

    if place is None:
        return
    folder = place.parent if option == "--json" else place
    try:
        if option == "--report":
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableError(f"{option} {place}: cannot be made: {error.strerror or error}") from error
    if not folder.is_dir():
        raise UnusableError(f"{option} {place}: there is no folder {folder}")
    if (option == "--json" and place.is_dir()) or not os.access(folder, os.W_OK):
        raise UnusableError(f"{option} {place}: cannot be written")


def measure_workloads(found: dict[str, Any], names: list[str], repetitions: int, peers: bool) -> dict[str, Any]:
    """Measures the standard workloads into `found`, shows each, and returns what is known of all."""
    from emt.benchmark.clock import one_core

    if not names:
        from emt.benchmark.measure import circumstances

        return circumstances(repetitions, None, None) | {"help_seconds": None}
    # before JAX is loaded, which would share small loops among all the processors that it finds
    with one_core() as core:
        from emt.benchmark import measure, peak, processes, report
        from emt.benchmark.rivals import DisagreementError

        try:
            fastest = peak.measured_peak()
            for name in names:
                options = {"repetitions": repetitions, "peers": peers, "peak": fastest.flops, "tell": say}
                found[name] = measure.measure(name, **options)
                typer.echo(report.workload_table(found[name]).render("text"))
            help_seconds = processes.help_seconds()
        except DisagreementError as error:
            say(str(error))
            raise typer.Exit(CHECK_FAILED) from error
        except processes.ChildError as error:
            raise UnusableError(str(error)) from error
    return measure.circumstances(repetitions, core, fastest) | {"help_seconds": help_seconds}


def measure_whole(results: dict[str, Any], names: list[str], sizes: list[int]) -> None:
    """Measures whole commands into `results`."""
    if not names:
        return
    from emt.benchmark.processes import ChildError
    from emt.benchmark.reproducing import reproduced
    from emt.benchmark.scaling import scaling

    try:
        if "scaling" in names:
            results["scaling"] = rows = []
            for row in scaling(sizes):
                rows.append(row)
                say(f"scaling: {row['runs']} runs in {row['wall']:.1f} s, {row['memory']:.0f} MiB")
        if "reproduce" in names:
            results["reproduce"] = reproduced(tell=say)
    except ChildError as error:
        raise UnusableError(str(error)) from error


def show(results: dict[str, Any], experiments: list[str], repetitions: int) -> None:
    """Judges and shows what was measured; times the experiments that are no workloads."""
    from emt.benchmark.goals import verdicts
    from emt.benchmark.report import method_of, tables_of

    results["goals"] = verdicts(results)
    for part in tables_of(results):
        typer.echo(part.render("text"))
    if results["workloads"]:
        typer.echo("\n".join(method_of(results)))
    if experiments:
        from emt.benchmark.parts import experiments_of, parts_table

        for name in [one for given in experiments for one in experiments_of(given)]:
            part = parts_table(name, repetitions)
            results["parts"][name] = list(part.values)
            typer.echo(part.render("text"))


def write(path: Path, text: str) -> None:
    """Writes a file in one step.

    Raises:
        UnusableError: it cannot be written.
    """
    from emt.store.files import FileSystem, write_atomically

    try:
        write_atomically(FileSystem(), path, text.encode("utf-8"))
    except OSError as error:
        raise UnusableError(f"{path}: cannot be written: {error.strerror or error}") from error
