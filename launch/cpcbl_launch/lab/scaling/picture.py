"""Bytes and CPU a robot against the size of the team. Needs extra `plot`."""

from pathlib import Path

import matplotlib as mpl

from cpcbl_launch.lab.scaling.measure import ScalingReport

mpl.use("Agg")

from matplotlib import pyplot as plt


def draw_scaling(scale: ScalingReport, path: Path) -> None:
    """Two panels: bytes a second that a robot sends and receives; CPU of its steps."""
    figure, (traffic, cpu) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    sizes = [s.robots for s in scale.sizes]
    for label, rates in (
        ("sent", [s.bytes_sent_per_s for s in scale.sizes]),
        ("received", [s.bytes_received_per_s for s in scale.sizes]),
    ):
        traffic.plot(sizes, rates, "o-", label=label)
    cpu.plot(sizes, [s.cpu_ms_per_s for s in scale.sizes], "o-", color="C2")
    traffic.set(title="fixes and beliefs of a robot", ylabel="bytes a second on their link")
    traffic.legend()
    cpu.set(title="CPU of a robot", ylabel="ms in a second of robot time")
    for axes in (traffic, cpu):
        axes.set(xlabel="robots in the team", xscale="log", ylim=(0, None))
        axes.set_xticks(sizes, labels=[str(size) for size in sizes], minor=False)
        axes.minorticks_off()
        axes.grid(True, alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
