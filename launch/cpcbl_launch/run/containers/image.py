"""The image that all containers of a team use: named after what it is built from."""

import hashlib
import re
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

from cpcbl_launch.run.containers import BASE_VARIABLE
from cpcbl_launch.run.containers.docker import DockerError, PrintLine, command_output, run_command

NAME = "cpcbl-team"
DOCKERFILE = Path("docker/Dockerfile")
SOURCES = (
    *("pyproject.toml", "README.md", "LICENSE", "docker/Dockerfile", "docker/linked"),
    *("cpcbl_team", "transport", "agents", "launch"),
)
"""What goes into the image, from the top of the checkout; .dockerignore lets in the same."""
BUILD_TIMEOUT_S = 1800.0
WITHOUT_REGISTRY = (
    f"without a registry of images: docker/base-image.sh, then {BASE_VARIABLE}=cpcbl-base"
)


def version() -> str:
    return metadata.version(NAME)


def checkout() -> Path | None:
    """The top of the checkout that this program runs from; None: it was installed without one."""
    top = Path(__file__).parents[4]
    return top if (top / DOCKERFILE).exists() else None


def tag(top: Path, base: str, extras: str = "") -> str:
    """cpcbl-team:VERSION-HASH, another one when a source, the recipe, the base's name or the extras
    change."""
    content = hashlib.sha256(f"{base} {extras}".encode())
    for path in _files(top):
        content.update(f"\n{path.relative_to(top)}\n".encode())
        content.update(path.read_bytes())
    return f"{NAME}:{version()}-{content.hexdigest()[:12]}"


def ensure_image(
    base: str, stop: Callable[[], bool], print_line: PrintLine, extras: str = ""
) -> str:
    """The name of an image of this very program with these extras, built where there is none yet.

    Raises DockerError.
    """
    top = checkout()
    if top is None:
        raise DockerError(
            "the image is built from a checkout, and this program was installed without one; name"
            " one that you have: --image NAME"
        )
    name = tag(top, base, extras)
    if not has_image(name):
        fetch_image(base, stop, print_line, WITHOUT_REGISTRY)
        print_line(f"building image {name} on {base}, once for these sources")
        command = [
            "docker",
            "build",
            "--force-rm",
            "--tag",
            name,
            "--build-arg",
            f"BASE_IMAGE={base}",
            "--build-arg",
            f"EXTRAS={extras}",
        ]
        command += ["--file", str(top / DOCKERFILE), str(top)]

        def print_step(line: str) -> None:
            step = build_step(line)
            if step is not None:
                print_line(step)

        command_output(command, stop, print_step, BUILD_TIMEOUT_S)
    return name


def has_image(image: str) -> bool:
    """Whether the daemon has an image."""
    return run_command(["docker", "image", "inspect", "--format", "{{.Id}}", image]).code == 0


def fetch_image(
    image: str, stop: Callable[[], bool], print_line: PrintLine, otherwise: str
) -> None:
    """Fetches an image that is not there. Raises DockerError, with what to do `otherwise`."""
    if has_image(image):
        return
    print_line(f"fetching image {image}")
    fetched = run_command(["docker", "pull", "--quiet", image], stop, timeout_s=BUILD_TIMEOUT_S)
    if fetched.code:
        raise DockerError(f"no image {image} ({fetched.problem}); {otherwise}")


def build_step(line: str) -> str | None:
    """Of all that a builder says (the classic one, or BuildKit) the lines that begin a step."""
    step = re.match(r"(?:Step (\d+/\d+) :|#\d+ \[.*?(\d+/\d+)\]) (.+)", line)
    return f"  {step[1] or step[2]} {step[3]}"[:78] if step else None


def _files(top: Path) -> Iterator[Path]:
    for source in SOURCES:
        path = top / source
        if path.is_file():
            yield path
        for inner in sorted(path.rglob("*")):
            if inner.is_file() and "__pycache__" not in inner.parts:
                yield inner
