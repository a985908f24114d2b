"""Experiments side by side, each in a process of its own."""

import pytest

from emt.cli.errors import UnusableError
from emt.cli.reproducing import Job, Scale, finished, spread


def test_a_job_that_cannot_run_says_why_through_its_process(tmp_path):
    """The process starts, with its share of threads, and finds the fault."""
    job = Job("benchmark/vb", ["monte_carlo.run=3"], Scale.smoke, tmp_path / "out")
    with pytest.raises(UnusableError, match=r"monte_carlo\.run.*did you mean 'runs'"):
        list(finished([job], 2))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("n", [0, 1, 4, 5])
def test_every_job_is_started_once(tmp_path, n):
    jobs = [Job(str(k), [], Scale.smoke, tmp_path) for k in range(n)]
    assert sorted(spread(jobs)) == jobs
