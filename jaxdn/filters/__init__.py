"""The pieces that classical temporal filters are made of: history, moments, variance, spatial averages."""
