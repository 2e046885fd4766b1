"""The performance-critical operations, one file each: the public function, a readable reference, faster versions."""
