"""A soft tactile dome in simulation, and networks that take the slide out of its images.

The way of the data is the layout: scene -> contact -> image -> dataset -> model -> training -> evaluation -> report.
Every step can be imported and used by itself; nothing is imported here, so the command line starts quickly.
"""

__version__ = "0.1.0"
