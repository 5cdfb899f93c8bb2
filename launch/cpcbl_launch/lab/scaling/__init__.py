"""Teams of any size on a field that grows with them, and what a robot costs in each."""
