"""What is proved of imitation, seen: theorems on processes solved exactly, control of linear systems, and an arm."""
