"""One trainer per field; the rays and pixels it is given; losses, schedules, metrics."""
