"""Measurements as tables and as a page of Markdown."""

from collections.abc import Mapping
from typing import Any

from emt.benchmark.clock import FEWEST, LONG_SECONDS
from emt.benchmark.goals import goals_table
from emt.benchmark.reproducing import reproduced_table
from emt.benchmark.rivals import BATCHED, PER_RUN, PLAIN
from emt.benchmark.scaling import scaling_table
from emt.reports.numbers import significant
from emt.reports.table import Column, Table

PARTS = {
    "filter": "emt, filter only",
    "end_to_end": "emt, end to end",
    "simulation": "emt, simulation alone",
}
NAMED = (BATCHED, PER_RUN, PLAIN)
"""Rivals with a column of their own in the summary."""


def workload_table(found: Mapping[str, Any]) -> Table:
    """One workload: emt's parts, its rivals, and below them what is no time per run and step."""
    columns = [
        Column("part", "part"),
        Column("version", "version"),
        Column("runs", "runs", True),
        Column("cpu", "CPU µs", True),
        Column("wall", "wall µs", True),
        Column("ratio", "of filter only", True),
        Column("agreement", "difference", True),
    ]
    own, rows, values = found["parts"], [], []
    for part, title in PARTS.items():
        ratio = own[part]["cpu"] / own["filter"]["cpu"]
        values.append({"part": title, "runs": found["runs"], **own[part], "ratio": ratio})
    values += [{"part": rival["name"]} | {k: v for k, v in rival.items() if k != "name"} for rival in found["rivals"]]
    for value in values:
        shown = {key: significant(value[key]) for key in ("cpu", "wall")}
        rows.append(
            {"part": value["part"], "version": value.get("version", ""), "runs": str(value["runs"]), **shown}
            | {"ratio": f"{value['ratio']:,.1f}", "agreement": value.get("agreement", "")}
        )
    rows += [{"part": one["name"], "version": one["reason"]} for one in found["missing"]]
    points = f"{significant(found['points_per_scan'])} points per scan"
    title = f"{found['number']} {found['name']}: µs per run and step, {found['runs']} runs of {found['steps']} steps"
    return Table(f"{title}, {points}", columns, rows, values, notes_of(found))


def notes_of(found: Mapping[str, Any]) -> list[str]:
    """Compilation, memory and rate in words, and remarks on rivals."""
    notes = [rival["remark"] for rival in found["rivals"] if rival["remark"]]
    if "compile" in found:
        cold, warm = found["compile"]["cold"], found["compile"]["warm"]
        notes.append(
            f"compilation: {cold['cpu']:.1f} s with an empty cache ({cold['wall']:.1f} s wall), {warm['cpu']:.1f} s "
            f"with a filled one ({warm['wall']:.1f} s); peak memory {cold['memory']:.0f} and {warm['memory']:.0f} MiB"
        )
    if "operations" in found:
        share = found["share_of_peak"]
        ending = "" if share is None else f", {100.0 * share:.1f}% of the multiply-add peak"
        rate = found["operations_per_second"] / 1e9
        notes.append(f"{found['operations']:,.0f} operations per run and step: {rate:.2f} Gflop/s{ending}")
    return notes


def summary_table(results: Mapping[str, Any]) -> Table:
    """All workloads in a line each."""
    columns = [
        Column("name", "workload"),
        Column("filter", "filter µs", True),
        Column("end_to_end", "end to end µs", True),
        Column("share", "of peak", True),
        *(Column(name, f"× {name}", True) for name in NAMED),
        Column("peers", "× other packages"),
        Column("cold", "cold s", True),
        Column("warm", "warm s", True),
        Column("memory", "MiB", True),
    ]
    rows, values = [], []
    for found in results["workloads"].values():
        ratios = {rival["name"]: rival["ratio"] for rival in found["rivals"]}
        others = {
            f"{r['name']} ({r['version'].split()[-1]})": r["ratio"] for r in found["rivals"] if r["name"] not in NAMED
        }
        share, compiled = found.get("share_of_peak"), found.get("compile")
        row = {"name": f"{found['number']} {found['name']}"}
        row |= {part: significant(found["parts"][part]["cpu"]) for part in ("filter", "end_to_end")}
        row["share"] = "" if share is None else f"{100.0 * share:.1f}%"
        row |= {name: f"{ratios[name]:,.1f}" for name in NAMED if name in ratios}
        row["peers"] = ", ".join(f"{name} {ratio:,.0f}" for name, ratio in others.items())
        if compiled:
            row |= {state: f"{compiled[state]['cpu']:.1f}" for state in ("cold", "warm")}
            row["memory"] = f"{compiled['cold']['memory']:.0f}"
        rows.append(row)
        values.append({"name": found["name"], **{k: v["cpu"] for k, v in found["parts"].items()}, **ratios})
    return Table("Summary: CPU time of one core", columns, rows, values)


def method_of(results: Mapping[str, Any]) -> list[str]:
    """How it was measured, in three lines."""
    core, peak = results["core"], results["peak"]
    place = "unbound" if core is None else f"bound to core {core} before JAX is loaded"
    kernel = ""
    if peak is not None:
        kernel = (
            f" The peak, {peak['flops'] / 1e9:.1f} Gflop/s, is that of multiply-adds on {peak['vectors']} × "
            f"{peak['length']} doubles in a kernel of XLA's own, measured in the same run."
        )
    return [
        f"Times are medians of {results['repetitions']} interleaved repetitions in one process, {place}: CPU time of "
        f"all its threads, wall clock beside it. Calls of more than {LONG_SECONDS:.0f} s are repeated at most {FEWEST} "
        "times.",
        "All are given the same simulated scans, and every rival is checked before it is timed: its largest relative "
        "difference from emt is shown (or that of position errors, where random numbers differ). Batched NumPy gets "
        "these runs again and again, as many at once as it is fastest with. Ratios are of CPU times per run and step. "
        "Compilation is tracing, lowering and compiling simulator and filter in a process of "
        "its own.",
        f"Operations are counted from the equations (emt/benchmark/operations.py), not from the program.{kernel}",
    ]


def tables_of(results: Mapping[str, Any]) -> list[Table]:
    """What follows the tables of the workloads."""
    tables = [summary_table(results)] if len(results["workloads"]) > 1 else []
    tables += [scaling_table(results["scaling"])] if results.get("scaling") else []
    tables += [reproduced_table(results["reproduce"])] if results.get("reproduce") else []
    return tables + ([goals_table(results["goals"])] if results["goals"] else [])


def markdown(results: Mapping[str, Any]) -> str:
    """The page."""
    about = results["environment"]
    versions = ", ".join(f"{name} {about[name]}" for name in ("emt", "python", "jax", "jaxlib", "numpy"))
    flags = about["xla_flags"] or "none"
    lines = ["# Benchmark", "", *(f"{line}\n" for line in method_of(results))]
    lines += [
        f"Machine: {about['cpu']} ({about['machine']}, {about['system']}). Versions: {versions}. XLA flags: {flags}."
    ]
    lines += [""]
    parts = [*map(workload_table, results["workloads"].values()), *tables_of(results)]
    return "\n".join([*lines, *(part.render("markdown") for part in parts)])
