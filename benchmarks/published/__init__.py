"""Our scores under the protocols of published tables, beside the figures of others."""
