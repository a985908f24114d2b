"""The report of a paper: every published table beside ours, claims, and the figures of each experiment."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from emt.config.shipped import published_path
from emt.reports.claims import claims_table
from emt.reports.estimates import estimates_table
from emt.reports.guide import guide_table
from emt.reports.published import (
    LEGEND,
    LEGEND_END,
    Origin,
    Published,
    comparison_table,
    load_published,
    median_table,
    summary_table,
)
from emt.reports.segments import segments_table
from emt.reports.summary import SUMMARY_FILE
from emt.reports.table import Table
from emt.store import RunReader, StoreError, read_folder

FIGURES = ("track.png", "over_time.png", "modes.png")
ANIMATION = "animation.gif"
TIMING_FILE = "timing.json"
FRAMES = (1, 2, 11, 20, 50, 80, 105)
"""Frames of a recording that a report shows."""


class PaperReport(NamedTuple):
    """Tables of a paper with the figures that go with each experiment."""

    paper: str
    published: Published | None
    tables: list[Table]
    figures: dict[str, Path]
    """File name in the report -> figure in a run folder."""

    def markdown(self, prefix: str) -> str:
        """The report as Markdown; figures are referred to by `prefix` and their names."""
        lines = [f"# {self.paper}", ""]
        if self.published is not None:
            origins: dict[Origin, None] = dict.fromkeys(table.origin for table in self.published.tables)
            legend = [*(line for origin in origins for line in LEGEND[origin]), LEGEND_END]
            lines += [self.published.citation, "", *[f"- {line}" for line in legend], ""]
            lines += [f"- `{name}`: {text}" for name, text in self.published.definitions.items()] + [""]
        lines += [part.render("markdown") for part in self.tables]
        lines += [f"![{name}]({prefix}{name})\n" for name in self.figures]
        return "\n".join(lines)

    def write(self, folder: Path, *, prefix: str = "", name: str = "report.md") -> Path:
        """Writes report and figures; returns the report's path."""
        folder.mkdir(parents=True, exist_ok=True)
        for figure, source in self.figures.items():
            (folder / f"{prefix}{figure}").write_bytes(source.read_bytes())
        (folder / name).write_text(self.markdown(prefix), encoding="utf-8")
        return folder / name


def read_summary(reader: RunReader) -> dict[str, Any]:
    """The summary of a finished run folder.

    Raises:
        StoreError: the experiment has not finished.
    """
    try:
        return reader.read_json(SUMMARY_FILE)
    except StoreError as error:
        raise StoreError(
            f"{reader.path}: has no {SUMMARY_FILE} yet; run `emt run` with this folder as --out to finish it"
        ) from error


def costs_of(reader: RunReader) -> dict[str, float]:
    """Microseconds per run and step of each filter, from the last time that runs were computed; none if unknown."""
    try:
        return reader.read_json(TIMING_FILE)["microseconds_per_run_and_step"]
    except (StoreError, KeyError):
        return {}


def published_of(paper: str | None) -> Published | None:
    """The published numbers of a paper, where there are any."""
    path = published_path(paper) if paper else None
    return load_published(path) if path else None


def experiment_tables(reader: RunReader, published: Published | None) -> list[Table]:
    """Published beside reproduced where there are numbers, then all metrics; estimates for recordings."""
    manifest = reader.manifest
    if not manifest["metrics"]:
        return [estimates_table(reader, frames=FRAMES)]
    summary, unit = read_summary(reader), manifest["length_unit"]
    tables = [
        comparison_table(part, summary, unit)
        for part in (published.tables if published else ())
        if part.experiment == summary["experiment"]
    ]
    tables.append(summary_table(summary, unit))
    if (stretches := segments_table(summary, unit)) is not None:
        tables.append(stretches)
    rule = manifest["identity"]["config"]["divergence"]
    return tables if rule is None or rule["exclude"] else [*tables, median_table(summary, unit)]


def folder_tables(folder: Path) -> list[Table]:
    """The tables of one run folder.

    Raises:
        StoreError: not a run folder, or not finished.
    """
    reader = read_folder(folder)
    return experiment_tables(reader, published_of(reader.manifest["paper"]))


def paper_report(paper: str, folders: Mapping[str, Path]) -> PaperReport:
    """The report over the run folders of a paper's experiments, by experiment name."""
    published = published_of(paper)
    tables, figures, summaries, readers = [], {}, {}, {}
    for name, folder in folders.items():
        reader = read_folder(folder)
        tables += experiment_tables(reader, published)
        if reader.manifest["metrics"]:
            summaries[name], readers[name] = read_summary(reader), reader
        short = name.split("/")[-1]
        wanted = (*FIGURES, ANIMATION) if published and name in published.animations else FIGURES
        figures |= {f"{short}-{figure}": folder / figure for figure in wanted if (folder / figure).is_file()}
    if published and published.guide:
        costs = {name: costs_of(reader) for name, reader in readers.items()}
        units = {name: reader.manifest["length_unit"] for name, reader in readers.items()}
        guide = guide_table(published.guide, summaries, costs, units)
        tables += [guide] if guide is not None else []
    if published and published.claims:
        tables.append(claims_table(published.claims, summaries, readers))
    return PaperReport(paper, published, tables, figures)
