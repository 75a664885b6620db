"""Time: a budget for the whole run, and how long stages are expected to take."""
