"""`cpcbl-team view`: the field in a browser. Bus -> feed -> pictures -> server -> page."""
