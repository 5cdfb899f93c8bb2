"""The messages between robots, their keys, and the bus that carries them."""
