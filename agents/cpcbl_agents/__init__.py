"""The three agents of a robot (sensing, filter, collaboration) and the process that runs them."""
