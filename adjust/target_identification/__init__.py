"""Which mark of an image is which object point, where nothing is known of its orientation."""
