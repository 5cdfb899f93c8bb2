"""Pictures of the simulated field, as a camera on a robot would take them."""
