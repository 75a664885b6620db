"""The stages in order: what has to run, by keys and manifests, in a workspace."""
