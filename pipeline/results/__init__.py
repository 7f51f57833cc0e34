"""Result files: each module writes and reads one format."""
