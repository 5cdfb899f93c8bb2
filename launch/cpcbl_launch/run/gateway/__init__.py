"""The gateway: inputs and poses as JSON over HTTP and WebSocket, for what has no Zenoh."""
