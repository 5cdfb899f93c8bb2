"""The laboratory: experiments, fault scenarios, scaling, baselines, and robots with faults."""
