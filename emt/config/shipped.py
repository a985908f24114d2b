"""The configurations and published numbers that come with emt, from a checkout or from an installed wheel."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
SHIPPED = _PACKAGE.parent if (_PACKAGE.parent / "configs").is_dir() else _PACKAGE / "_shipped"


BENCHMARK = "benchmark"
"""Folder of the shipped experiments that are workloads of `emt bench` and belong to no paper."""


def config_names(paper: str | None = None) -> list[str]:
    """Names of the shipped experiments, `PAPER/EXPERIMENT`, of one paper or of all."""
    root = SHIPPED / "configs"
    found = sorted(path.relative_to(root).with_suffix("").as_posix() for path in root.glob("*/*.yaml"))
    return [name for name in found if paper is None or name.split("/")[0] == paper]


def papers() -> list[str]:
    """Keys of the papers with shipped experiments."""
    return sorted({name.split("/")[0] for name in config_names()} - {BENCHMARK})


def config_path(name: str) -> Path:
    """The file of a shipped experiment; it need not exist."""
    return SHIPPED / "configs" / f"{name}.yaml"


def published_path(paper: str) -> Path | None:
    """The published numbers of a paper, where there are any."""
    path = SHIPPED / "experiments" / paper / "published.yaml"
    return path if path.is_file() else None
