"""The version of the package, for files that name who wrote them."""

__version__ = "0.3.0.dev0"
