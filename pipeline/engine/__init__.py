"""The stages in order: what has to run, by cache keys and manifests, in a workspace."""
