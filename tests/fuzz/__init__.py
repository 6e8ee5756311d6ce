"""Bad inputs: a clear error of ours, or a finite answer of the right shape; never a crash, a hang or a silent NaN."""
