"""Orchestration and words for the user: command line, runner, manifests, workspace, demo."""
