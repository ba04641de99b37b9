"""carom learns mechanical systems with contact from trajectories and hands back a differentiable simulator."""

from carom.contact.candidates import Contact as Contact
from carom.contact.candidates import DiskDisk as DiskDisk
from carom.contact.candidates import DiskPlane as DiskPlane
from carom.contact.impulses import contact_impulse as contact_impulse
from carom.contact.impulses import solve_impulse as solve_impulse
from carom.errors import CaromError as CaromError
from carom.learning.dataset import Dataset as Dataset
from carom.learning.dataset import recording_of as recording_of
from carom.learning.evaluate import evaluate as evaluate
from carom.learning.model_file import save_model as save_model
from carom.learning.models import NeuralPotential as NeuralPotential
from carom.learning.train import LearnConfig as LearnConfig
from carom.learning.train import LearnReport as LearnReport
from carom.learning.train import learn as learn
from carom.mechanics.bodies import Body as Body
from carom.mechanics.bodies import PointMass as PointMass
from carom.mechanics.bodies import RigidBody as RigidBody
from carom.mechanics.constraints import Constraint as Constraint
from carom.mechanics.constraints import Distance as Distance
from carom.mechanics.constraints import Joint as Joint
from carom.mechanics.constraints import Tether as Tether
from carom.mechanics.potentials import Gravity as Gravity
from carom.mechanics.potentials import NoPotential as NoPotential
from carom.mechanics.potentials import Potential as Potential
from carom.simulation.files import Recording as Recording
from carom.simulation.files import load_recording as load_recording
from carom.simulation.files import save_recording as save_recording
from carom.simulation.integrators import RK4 as RK4
from carom.simulation.rollout import Trajectory as Trajectory
from carom.simulation.rollout import simulate as simulate
from carom.system import System as System
from carom.tasks import load_model as load_model
from carom.tasks import make_recording as make_recording
from carom.tasks import sample as sample
from carom.tasks import task as task

__version__ = "0.1.0"
