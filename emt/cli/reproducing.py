"""`emt reproduce`: all experiments of the papers, as many at a time as there are processors."""

import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from enum import StrEnum
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from emt.cli.errors import InterruptedRunError, UnusableError, expected_errors, say


class Scale(StrEnum):
    """How many runs."""

    smoke = "smoke"
    paper = "paper"


class Job(NamedTuple):
    """One experiment to run, as plain data."""

    name: str
    overrides: list[str]
    scale: Scale
    folder: Path


def reproduce(
    papers: Annotated[list[str] | None, typer.Argument(metavar="[PAPER]...", help="Papers; all by default.")] = None,
    scale: Annotated[Scale, typer.Option(help="Number of runs: the paper's table, or a quick look.")] = Scale.paper,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default results/reproduce-SCALE.")] = None,
    data: Annotated[
        list[Path] | None, typer.Option("--data", help="A recording, or a folder of recordings, found by its hash.")
    ] = None,
    tables: Annotated[Path | None, typer.Option(help="Also write reports with figures into this folder.")] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Experiments at a time; default one per processor.")] = None,
) -> None:
    """Run every experiment of the papers and show published beside reproduced numbers.

    Experiments on recordings are skipped, with a word, unless --data leads to their file.

    Example: emt reproduce tuncer2021 --scale smoke
    """
    from emt.config.load import load_experiment
    from emt.config.shipped import config_names
    from emt.config.shipped import papers as shipped_papers
    from emt.device import processors
    from emt.registry import suggest
    from emt.reports.paper import paper_report

    wanted = papers or shipped_papers()
    for paper in wanted:
        if paper not in shipped_papers():
            near = suggest(paper, shipped_papers())
            hint = f" (did you mean '{near}'?)" if near else ""
            raise UnusableError(f"unknown paper '{paper}'{hint}; known: {', '.join(shipped_papers())}")
    out = Path("results") / f"reproduce-{scale}" if out is None else out
    loaded = [load_experiment(name) for paper in wanted for name in config_names(paper)]
    recordings = find_recordings(loaded, data or [])
    queue = []
    for item in loaded:
        overrides = []
        if item.experiment.scenario.kind == "recorded" and item.experiment.scenario.path is None:
            if item.name not in recordings:
                say(f"{item.name}: skipped, it needs its recording: --data PATH")
                continue
            overrides = [f"scenario.path={recordings[item.name]}"]
        queue.append(Job(item.name, overrides, scale, out / item.name))
    missing, waiting = {job.name for job in queue}, list(wanted)

    def report_complete() -> None:
        """Reports of the papers, in order, whose experiments are done."""
        while waiting and not any(name.startswith(f"{waiting[0]}/") for name in missing):
            paper = waiting.pop(0)
            report = paper_report(paper, {job.name: job.folder for job in queue if job.name.startswith(f"{paper}/")})
            for part in report.tables:
                typer.echo(part.render("text"))
            say(f"report: {report.write(out / paper)}")
            if tables is not None:
                say(f"report: {report.write(tables, prefix=f'{paper}-', name=f'{paper}.md')}")

    report_complete()
    for name in finished(queue, jobs or processors()):
        missing.discard(name)
        report_complete()


def spread(jobs: list[Job]) -> list[Job]:
    """The jobs in an order that starts neighbours, which often share compiled programs, at different times."""
    half = (len(jobs) + 1) // 2
    pairs = zip(jobs[:half], [*jobs[half:], None], strict=False)
    return [job for pair in pairs for job in pair if job is not None]


def finished(jobs: list[Job], at_once: int) -> Iterator[str]:
    """Names of the experiments as they get done, so many at a time, each in a process of its own.

    Tracing, compiling and drawing keep one processor busy each; experiments do not wait for one another.
    """
    from emt.device import threads_of_each

    began, count = time.perf_counter(), len(jobs)
    at_once = min(at_once, max(count, 1))
    say(f"{count} experiments, {at_once} at a time; the first ones are compiling, which takes half a minute")
    context, share = multiprocessing.get_context("spawn"), threads_of_each(at_once)
    with ProcessPoolExecutor(at_once, mp_context=context, initializer=settle, initargs=(share,)) as pool:
        try:
            futures = [pool.submit(run_job, job) for job in spread(jobs)]
            for done, future in enumerate(as_completed(futures), start=1):
                name, text, error = future.result()
                if error:
                    raise UnusableError(error)
                say(progress(done, count, time.perf_counter() - began, name, text))
                yield name
        except KeyboardInterrupt:
            message = "interrupted: finished chunks of runs are kept; the same command continues"
            raise InterruptedRunError(message) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def settle(environment: dict[str, str]) -> None:
    """Prepares a process for its jobs, before it loads JAX."""
    os.environ.update(environment)


def run_job(job: Job) -> tuple[str, str, str]:
    """Runs one experiment; its name, what there is to say of it, and what the user must change if it cannot run."""
    from emt.config.load import at_smoke_scale, load_experiment
    from emt.runner import run

    began = time.perf_counter()
    try:
        loaded = load_experiment(job.name, job.overrides)
        loaded = at_smoke_scale(loaded) if job.scale == Scale.smoke else loaded
        summary = run(loaded, job.folder)
    except expected_errors() as error:
        return job.name, "", str(error)
    return job.name, f"{summary['runs']} runs in {time.perf_counter() - began:.1f} s", ""


def progress(done: int, count: int, seconds: float, name: str, text: str) -> str:
    """What is said when an experiment is done; `emt bench reproduce` reads it."""
    return f"[{done}/{count}, {seconds:.0f} s] {name}: {text}"


def find_recordings(loaded, places: list[Path]) -> dict[str, Path]:
    """The file of every recorded experiment that is found, by its hash, at or under the given places."""
    import hashlib

    wanted = {
        item.experiment.scenario.sha256: item.name for item in loaded if item.experiment.scenario.kind == "recorded"
    }
    found = {}
    for place in places:
        if not place.exists():
            raise UnusableError(f"--data {place}: there is no such file or folder")
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if path.is_file() and path.suffix.lower() in (".mat", ".csv"):
                digest = hashlib.sha256(path.read_bytes()).hexdigest()
                if digest in wanted:
                    found[wanted[digest]] = path.resolve()
    return found
