"""carom learns mechanical systems with contact from trajectories and hands back a differentiable simulator."""

# The public names and where they come from are listed in __init__.pyi; each is imported when it is first used, so that
# the command line can set up logging before JAX is loaded.
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
