"""A small experiment that compiles quickly, for tests of the engine."""

from pathlib import Path

TEXT = """
title: Small
monte_carlo: {runs: 40, smoke_runs: 8, seed: 3, chunk: 16}
scenario:
  kind: stationary
  steps: 4
  semi_axes: [10, 4]
  detections:
    count: {kind: poisson, mean: 6}
    source: uniform
    noise_cov: [[0.5, 0.1], [0.1, 0.4]]
    max_points: 24
model:
  process_noise: {kind: white_acceleration, psd: 0.01}
  noise_cov: [[0.5, 0.1], [0.1, 0.4]]
  extent_scale: 0.25
  prior:
    mean: [1, -1, 0, 0]
    cov: {diagonal: [4, 4, 1, 1]}
    orientation: 0.2
    semi_axes: [8, 5]
filters:
  feldmann: {kind: feldmann, weight: 8, decay: {kind: weight, factor: 0.9}}
metrics: [gw, gw_std, position_rmse]
"""


def write(folder: Path, text: str = TEXT, name: str = "small.yaml") -> Path:
    """The experiment as a file."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path
