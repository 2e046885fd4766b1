"""Mitsuba itself: which variant computes, and the errors that say what to do."""
