"""`cpcbl-team view`: the field in a browser. Bus -> feed -> page data -> server -> page."""
