"""Where the page is served, and to whom: ports, host names and the browser's own rules.

A foreign page in the same browser could send requests here. It is refused by its `Origin`; and a
foreign name that resolves to this machine (DNS rebinding) by its `Host`. A host that is an IP
address cannot have been rebound.
"""

import errno
import ipaddress
import re
import socket
from typing import NamedTuple

from cpcbl_team.errors import InputError

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8700
EVERYWHERE = ("0.0.0.0", "::")


class Listen(NamedTuple):
    """Where to serve; a port that was not chosen may be another one."""

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    is_chosen: bool = False
    option: str = "--listen"

    @property
    def is_open(self) -> bool:
        """Whether other machines can reach it."""
        try:
            return not ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host != "localhost"


def parse_listen(option: str, text: str | None) -> Listen:
    """`ADDRESS:PORT`, `ADDRESS` or `:PORT`; this machine alone by default. Raises InputError."""
    if text is None:
        return Listen(option=option)
    found = re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[\w.-]*)(?::(\d{1,5}))?", text.strip())
    is_one = found is not None and any(found.groups()) and not found[0].isdecimal()
    if not found or not is_one or int(found[2] or 0) > 65_535:
        raise InputError(f"{option} {text}: write ADDRESS:PORT, such as 0.0.0.0:{DEFAULT_PORT}")
    port = DEFAULT_PORT if found[2] is None else int(found[2])
    return Listen(found[1].strip("[]") or DEFAULT_HOST, port, found[2] is not None, option)


def listening_socket(listen: Listen) -> socket.socket:
    """A socket that listens there; at a free port where the default one is taken. Raises
    InputError."""
    family = socket.AF_INET6 if ":" in listen.host else socket.AF_INET
    try:
        return socket.create_server((listen.host, listen.port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE and not listen.is_chosen:
            return socket.create_server((listen.host, 0), family=family)
        reason = (error.strerror or str(error)).partition(" (")[0].lower()
        raise InputError(
            f"{listen.option} {listen.host}:{listen.port}: {reason}; name another address or port"
        ) from error


def page_address(listen: Listen, port: int) -> str:
    """The address to type into a browser."""
    host = own_address() if listen.host in EVERYWHERE else listen.host
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def own_address() -> str:
    """The address of this machine in its network; its name where it has none. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def is_own_host(host: str, listen: Listen) -> bool:
    """Whether a request's `Host` is a name of this server."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[^:\[\]]+)(?::\d{1,5})?", host)
    if not found:
        return False
    name = found[1].strip("[]").lower()
    try:
        ipaddress.ip_address(name)
    except ValueError:
        own = socket.gethostname().lower()
        return name in {"localhost", listen.host.lower(), own, f"{own}.local"}
    return True


def is_own_origin(origin: str | None, host: str) -> bool:
    """Whether a WebSocket was opened by this server's own page; programs name no origin."""
    return origin is None or origin == f"http://{host}"


def security_headers(host: str) -> dict[str, str]:
    """The browser loads nothing from elsewhere, runs no inline script, and frames nothing."""
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:;"
        f" connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none';"
        " frame-ancestors 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
    }
