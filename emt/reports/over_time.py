"""Metrics scan by scan, for those who draw their own figures."""

from emt.averaging import OF_SINGLE_RUNS
from emt.reports.numbers import significant
from emt.reports.summary import curves
from emt.reports.table import Column, Table
from emt.store import RunReader


def curves_table(reader: RunReader) -> Table:
    """Mean and standard deviation over runs of every metric of every filter at every scan (from 1).

    Where a metric is averaged as a square, `mean` is the mean square and `root` its root.
    """
    metrics = {m["name"]: m for m in reader.manifest["metrics"]}
    names = ("filter", "metric", "scan", "mean", "std", "root", "runs")
    rows, values = [], []
    for label in reader.manifest["filters"]:
        for name, curve in curves(reader, label).items():
            if metrics[name]["over_runs"] not in OF_SINGLE_RUNS or metrics[name]["over_time"] == "end":
                continue
            is_square = metrics[name]["over_time"] == "rms"
            for k, (mean, std) in enumerate(zip(curve.mean.tolist(), curve.std.tolist(), strict=True)):
                numbers = {"mean": mean, "std": std, "root": max(mean, 0.0) ** 0.5 if is_square else None}
                row = {"filter": label, "metric": name, "scan": k + 1} | numbers | {"runs": curve.runs}
                printed = {key: "" if v is None else significant(v, 5) for key, v in numbers.items()}
                rows.append({key: str(value) for key, value in row.items()} | printed)
                values.append(row)
    title = f"{reader.manifest['identity']['experiment']}: over time"
    return Table(title, [Column(n, n, n not in ("filter", "metric")) for n in names], rows, values)
