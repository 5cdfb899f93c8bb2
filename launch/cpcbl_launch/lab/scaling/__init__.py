"""Teams of any size on a field that grows with them, and what one robot costs in each."""
