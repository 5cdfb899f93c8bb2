"""What a run leaves behind: notes, recordings, figures, tables and pictures."""
