"""Pages that need no server: sections, pictures, charts, and clouds in three dimensions."""
