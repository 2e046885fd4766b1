"""The few hot operations, a file each: the public function, a readable reference, faster forms of the same maths."""
