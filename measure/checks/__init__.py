"""What else is known of a measured mark, compared with its place."""
