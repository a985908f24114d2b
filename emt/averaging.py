"""Names of the rules by which values of steps and runs become one number; free of JAX, so that reports can read them.

Over the steps of a run: "mean"; "rms", the root of the mean of squared errors; "max", the largest; "end", what is made
of the end of the run. Over runs:

- "mean": mean of the values of runs;
- "std", "var", "max": sample standard deviation, sample variance, and largest of the values of runs;
- "rms": root over runs of the mean square at each step, then the mean over steps;
- "pooled": root of the mean square over runs and steps;
- "peak": the largest over steps of the root over runs of the mean square;
- "band": share of the steps at which the mean over runs of a normalised square lies inside its two-sided 95 %
  chi-square band.
"""

from typing import Literal

OverTime = Literal["mean", "rms", "max", "end"]
OverRuns = Literal["mean", "std", "var", "max", "rms", "pooled", "peak", "band"]
OF_SINGLE_RUNS = ("mean", "rms", "pooled")
"""Rules under which a single run has a value of its own, and steps a curve."""
