"""One file per sink: where records go."""
