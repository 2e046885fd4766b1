"""Ready denoisers: methods with their shipped or trained weights."""
