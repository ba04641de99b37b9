"""carom learns mechanical systems with contact from trajectories and hands back a differentiable simulator."""

from .contact.candidates import Contact as Contact
from .contact.candidates import DiskDisk as DiskDisk
from .contact.candidates import DiskPlane as DiskPlane
from .contact.candidates import RimPlane as RimPlane
from .contact.impulses import contact_impulse as contact_impulse
from .contact.impulses import solve_impulse as solve_impulse
from .contact.limits import BendLimit as BendLimit
from .contact.limits import StretchLimit as StretchLimit
from .errors import CaromError as CaromError
from .learning.dataset import Dataset as Dataset
from .learning.dataset import recording_of as recording_of
from .learning.evaluate import evaluate as evaluate
from .learning.identify import Estimate as Estimate
from .learning.identify import Identification as Identification
from .learning.identify import identify as identify
from .learning.model_file import save_model as save_model
from .learning.models import NeuralPotential as NeuralPotential
from .learning.refine import IdentifyConfig as IdentifyConfig
from .learning.train import LearnConfig as LearnConfig
from .learning.train import LearnReport as LearnReport
from .learning.train import learn as learn
from .mechanics.bodies import Body as Body
from .mechanics.bodies import PointMass as PointMass
from .mechanics.bodies import RigidBody as RigidBody
from .mechanics.constraints import Constraint as Constraint
from .mechanics.constraints import Distance as Distance
from .mechanics.constraints import Joint as Joint
from .mechanics.constraints import Tether as Tether
from .mechanics.potentials import Gravity as Gravity
from .mechanics.potentials import NoPotential as NoPotential
from .mechanics.potentials import Potential as Potential
from .mechanics.potentials import Springs as Springs
from .mechanics.potentials import Sum as Sum
from .simulation.files import Recording as Recording
from .simulation.files import load_recording as load_recording
from .simulation.files import save_recording as save_recording
from .simulation.integrators import RK4 as RK4
from .simulation.rollout import Trajectory as Trajectory
from .simulation.rollout import simulate as simulate
from .system import System as System
from .tasks import load_model as load_model
from .tasks import make_recording as make_recording
from .tasks import sample as sample
from .tasks import task as task

__version__: str
