"""Says in words why a TLS link cannot be opened. Zenoh itself only reports a time-out."""

import socket
import ssl

from cpcbl_transport.security import Credentials

WITHIN_S = 1.0
_ALERTS = {
    "CERTIFICATE_EXPIRED": "it has expired there, or the clock is wrong",
    "UNKNOWN_CA": "it is of another authority",
    "CERTIFICATE_UNKNOWN": "it is of another authority",
    "DECRYPT_ERROR": "it is of another authority",
    "BAD_CERTIFICATE": "it has expired there, or is not yet valid",
}


def tls_diagnosis(endpoint: str, credentials: Credentials) -> str:
    """Why a TLS handshake with the router at an endpoint fails; empty if it succeeds."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    try:
        context = ssl.create_default_context(cafile=credentials.ca)
        context.load_cert_chain(credentials.certificate, credentials.private_key)
    except (OSError, ssl.SSLError) as error:
        return f"{credentials.certificate}: cannot be used: {error.strerror or error}"
    try:
        with socket.create_connection((host, int(port)), WITHIN_S) as plain:
            return _refusal(plain, context, host, credentials)
    except OSError as error:
        return error.strerror or str(error)


def _refusal(
    plain: socket.socket, context: ssl.SSLContext, host: str, credentials: Credentials
) -> str:
    try:
        link = context.wrap_socket(plain, server_hostname=host)
    except TimeoutError:
        return "it does not speak TLS"
    except ssl.SSLCertVerificationError as error:
        return f"its certificate cannot be trusted: {error.verify_message}"
    try:
        link.recv(1)  # a server's judgement of the certificate comes after the handshake
    except TimeoutError:
        return ""
    except ssl.SSLError as error:
        alert = str(error.reason or error)
        known = next((text for name, text in _ALERTS.items() if alert.endswith(name)), alert)
        return f"it refuses {credentials.certificate}: {known}"
    finally:
        link.close()
    return ""
