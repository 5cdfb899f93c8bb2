"""How to install what not everybody needs: the extras of this package (pyproject.toml)."""

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

PACKAGE = "cpcbl-team"


def install_command(extra: str) -> str:
    """`pip install --editable '/home/me/cpcbl-team[camera]'`: the command that adds an extra to
    this installation, from where it came (PEP 610). The package is on no registry."""
    from importlib import metadata  # 1.6 MiB, which no robot needs

    try:
        text = metadata.distribution(PACKAGE).read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        text = None
    return command_from_origin(json.loads(text or "{}"), extra)


def command_from_origin(origin: dict[str, Any], extra: str) -> str:
    """The same by what `direct_url.json` says; for any checkout, if its folder is not there."""
    url = str(origin.get("url", ""))
    if "vcs_info" in origin:
        vcs = origin["vcs_info"].get("vcs", "git")
        return f"pip install '{PACKAGE}[{extra}] @ {vcs}+{url}'"
    path = Path(unquote(urlsplit(url).path))
    if not url.startswith("file:") or not (path / "pyproject.toml").is_file():
        return f"pip install '.[{extra}]' in a checkout of {PACKAGE}"
    editable = "--editable " if origin.get("dir_info", {}).get("editable") else ""
    return f"pip install {editable}'{path}[{extra}]'"
