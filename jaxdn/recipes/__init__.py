"""What a network is trained for: recipes, objectives, and augmentation."""
