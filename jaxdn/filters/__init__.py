"""The parts of classical temporal filters: history, moments, variance, spatial averages."""
