"""What a planned network of photographs would give: `reseau design`."""
