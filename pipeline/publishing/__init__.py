"""From what each result was made, and how the results of a command take the places of earlier ones together."""
