"""`emt list`, `emt show`, `emt schema`: what there is, and what a configuration says."""

import json
from typing import Annotated, Any

import typer


def list_names() -> None:
    """List experiments, filters, scenarios and metrics.

    Example: emt list
    """
    from emt.config import experiment  # noqa: F401  (fills the registries)
    from emt.config.load import find_config
    from emt.config.shipped import config_names
    from emt.config.source import load_source
    from emt.metrics.base import FAMILIES, METRICS
    from emt.registry import FILTERS, SCENARIOS
    from emt.reports.table import Column, Table

    experiments = [(name, str(load_source(find_config(name)).data.get("title", ""))) for name in config_names()]
    kinds = [
        (registry.what + "s", [(name, first_line(registry.get(name).settings.__doc__)) for name in registry.builtin()])
        for registry in (FILTERS, SCENARIOS)
    ]
    families = {pattern: make("NAME")._replace(name=pattern) for pattern, make in FAMILIES.items()}
    metrics = [(m.name, f"{m.definition} [{m.unit}]") for _, m in sorted((METRICS | families).items())]
    for title, rows in [("experiments", experiments), *kinds, ("metrics (L: length unit)", metrics)]:
        columns = [Column("name", "name"), Column("what", "what it is")]
        cells = [{"name": name, "what": what} for name, what in rows]
        typer.echo(Table(title, columns, cells, cells).render("text"))


def first_line(text: str | None) -> str:
    """The first sentence of a docstring, without its full stop."""
    return (text or "").strip().split("\n")[0].rstrip(".")


def show(
    config: Annotated[str, typer.Argument(help="A file, or the name of a shipped experiment.")],
    overrides: Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Settings to change.")] = None,
) -> None:
    """Show a configuration as it will be used: every setting, its unit, and where its value comes from.

    Example: emt show tuncer2021/trajectory_uniform scenario.speed='60 km/h'
    """
    from emt.config.load import load_experiment
    from emt.reports.table import Column, Table

    loaded = load_experiment(config, overrides or [])
    experiment = loaded.experiment
    origin = {key: group.replace("_", " ") for group, keys in experiment.sources for key in keys}
    rows = []
    for path, value, unit in settings_of(experiment):
        if path[0] == "sources" or value is None:
            continue
        given = [origin[".".join(path[:n])] for n in range(1, len(path) + 1) if ".".join(path[:n]) in origin]
        unit = (unit or "").replace("m", experiment.length_unit) if experiment.length_unit != "m" else unit or ""
        rows.append(
            {"key": ".".join(path), "value": show_value(value), "unit": unit, "from": given[-1] if given else ""}
        )
    columns = [Column("key", "setting"), Column("value", "value"), Column("unit", "unit"), Column("from", "from")]
    typer.echo(Table(f"{loaded.name}: {experiment.title}", columns, rows, rows).render("text"), nl=False)


def settings_of(settings: Any, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any, str | None]]:
    """(key path, value, unit) of every leaf of nested settings."""
    from pydantic import BaseModel

    from emt.settings import field_unit

    rows = []
    for name in type(settings).model_fields:
        value, here = getattr(settings, name), (*path, name)
        groups = (
            [(here, value)]
            if isinstance(value, BaseModel)
            else [((*here, str(key)), item) for key, item in items_of(value) if isinstance(item, BaseModel)]
        )
        for key, group in groups:
            rows.extend(settings_of(group, key))
        if not groups:
            unit = field_unit(type(settings), name)
            single = {(*here, str(key)): item for key, item in value.items()} if isinstance(value, dict) else {}
            rows.extend((key, item, unit) for key, item in (single or {here: value}).items())
    return rows


def items_of(value: Any) -> list[tuple[Any, Any]]:
    """Entries of a mapping or sequence with their keys or positions."""
    if isinstance(value, dict):
        return list(value.items())
    return list(enumerate(value)) if isinstance(value, tuple) else []


def show_value(value: Any) -> str:
    """A value as it could stand in the file."""
    if isinstance(value, tuple) and value and all(isinstance(row, tuple) for row in value):
        n = len(value)
        if all(len(row) == n for row in value):
            off_diagonal = any(value[i][j] for i in range(n) for j in range(n) if i != j)
            if not off_diagonal:
                return f"{{diagonal: {json.dumps([value[i][i] for i in range(n)])}}}"
    return json.dumps(value, ensure_ascii=False)


def schema() -> None:
    """Print the JSON Schema of configuration files, for completion and checks in editors.

    Example: emt schema > emt.schema.json
    """
    from pydantic import TypeAdapter

    from emt.config.experiment import ConnectedExperiment, Experiment

    either = TypeAdapter(Experiment | ConnectedExperiment).json_schema()
    content = {"$schema": "https://json-schema.org/draft/2020-12/schema", **either}
    typer.echo(json.dumps(content, indent=2, ensure_ascii=False))
