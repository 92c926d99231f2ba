"""The simulated machine: recipe, schedule, heat, air and effects, with exactly known states."""
