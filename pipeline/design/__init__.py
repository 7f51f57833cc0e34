"""Network design: the expected precision and reliability of planned photographs, `reseau design`."""
