"""Files that more than one stage reads or writes, and how amounts and progress are told."""
