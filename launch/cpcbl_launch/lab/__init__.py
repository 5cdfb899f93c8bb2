"""The laboratory: experiments, fault scenarios, baselines, and robots with faults."""
