"""What is adjusted: a network, its numbered quantities and their equations F1 to F4; and the form of the result."""
