"""The command `mitsuba-crb`."""
