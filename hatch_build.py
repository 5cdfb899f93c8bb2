"""Compiles the hot files of the core (docs/cost.md): `HATCH_BUILD_HOOKS_ENABLE=1 pip install .`

Without that switch of Hatch's nobody reads this. Nothing is written to the checkout: what is
compiled goes into the wheel, and not into an editable install, where it would grow stale.
"""

import os
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from mypyc.build import mypycify
from setuptools import Distribution
from setuptools.command.build_ext import build_ext

HOT = (
    "arc_fit",
    "arcs",
    "calibration_filter",
    "constant_errors",
    "constraints",
    "estimate",
    "filter_corrections",
    "fusion",
    "gaussian",
    "gate",
    "geometry",
    "landmarks",
    "localizer",
    "lost_reasons",
    "map_rejections",
    "map_residuals",
    "miscalibration",
    "motion",
    "object_timers",
    "own_calibration",
    "prediction",
    "recovery",
    "recovery_evidence",
    "relinearization",
    "relocalization",
    "scale_errors",
    "second_filters",
    "sensors",
    "state",
    "teammates",
    "variants",
)
OPTIONS = ["--strict", "--namespace-packages", "--explicit-package-bases", "--config-file="]


class CompiledCore(BuildHookInterface[Any]):
    """Adds extension modules to the wheel, beside the files that they were compiled from."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":
            return
        self._folder = TemporaryDirectory()
        files = [f"cpcbl_team/{name}.py" for name in HOT]
        build_data.update(pure_python=False, infer_tag=True)
        build_data["force_include"].update(_compiled(files, self._folder.name))

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        if hasattr(self, "_folder"):
            self._folder.cleanup()


def _compiled(files: list[str], folder: str) -> dict[str, str]:
    """The extension modules of these files of the checkout: where each is, and its place in the
    wheel."""
    options = [*OPTIONS, f"--cache-dir={folder}/cache"]
    modules = mypycify([*options, *files], target_dir=f"{folder}/c")
    for module in modules:  # so that the C compiler may inline calls between the files
        module.extra_compile_args.append("-fvisibility=hidden")
    command = build_ext(Distribution({"ext_modules": modules}))
    command.build_lib, command.build_temp = f"{folder}/lib", f"{folder}/o"
    command.ensure_finalized()
    command.run()
    built = command.get_outputs()
    return {path: os.path.relpath(path, f"{folder}/lib") for path in built}
