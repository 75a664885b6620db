"""Effects that a scene may call for, each a part of its own; one that is off is not there."""
