"""`cpcbl-team report`: a recorded run, or two side by side, as one page that needs nothing else."""
