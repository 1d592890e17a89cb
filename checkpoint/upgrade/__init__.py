"""What was recorded by an earlier version of the program, as the present one has it: mapped by the names of fields."""
