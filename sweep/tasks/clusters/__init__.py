"""How workers are started on each kind of cluster."""
