"""The process and its files: atomic writes, memory of the allocator, optional packages, interruption."""
