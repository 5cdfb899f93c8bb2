"""What robots say to each other, under which keys, and the bus that carries it."""
