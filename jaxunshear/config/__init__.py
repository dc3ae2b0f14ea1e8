"""What can be set, and what of it cannot be: every step reads its settings here. Imports neither JAX nor any step."""
