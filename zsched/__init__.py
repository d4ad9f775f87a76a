"""zsched: masterless scheduling of shared robot tasks over zenoh."""

try:
    from zsched._version import __version__
except ModuleNotFoundError:  # sources that nobody has built or installed: the build writes that file, by git's tags
    __version__ = "0+unknown"

__all__ = ["__version__"]
