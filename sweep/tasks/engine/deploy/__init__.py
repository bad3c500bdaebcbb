"""Workers started on each kind of cluster."""
