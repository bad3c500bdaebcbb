"""Where stores are kept, on disk or in an object store, and what the engine needs of a place."""
