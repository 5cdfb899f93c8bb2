"""What robots see, for people: annotated frames."""
