"""The simulated world: the field, who has a body on it, who lies."""
