"""A program as a service: it is run, reloaded and watched, a new project for one, and a look at the machine for it."""
