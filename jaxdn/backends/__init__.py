"""The few hot operations, each with a readable reference and faster implementations of the same maths."""
