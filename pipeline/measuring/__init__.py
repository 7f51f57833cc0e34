"""From scans to comparator coordinates."""
