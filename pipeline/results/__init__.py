"""What the program writes: from what each result was made, and how results take the places of earlier ones."""
