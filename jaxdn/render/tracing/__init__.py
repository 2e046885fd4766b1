"""Path tracing: vectorised and scalar, sample streams, seeds and Mitsuba's variants."""
