"""A module per field: what stage train has to know of it, and a light one with its options."""
