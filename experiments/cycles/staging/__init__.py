"""What scenes are built of: meshes, materials, rooms, furniture, plants, streets, lamps, cameras, a walking figure."""
