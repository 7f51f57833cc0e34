"""From comparator coordinates to the adjustment and its files."""
