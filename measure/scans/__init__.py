"""A scan file: opened by windows, whatever its format, its numbers turned into grey values that grow with light."""
