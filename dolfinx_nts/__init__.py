"""Node-to-surface contact for FEniCSx, with integrators that conserve what physics conserves."""

from importlib.metadata import version

from dolfinx_nts import mpi_first  # noqa: F401 - before anything of DOLFINx
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.conditions import Dirichlet
from dolfinx_nts.bodies.loads import Pressure, Traction
from dolfinx_nts.bodies.meshes.mesh_input import Part, bodies_from_gmsh, bodies_from_tags
from dolfinx_nts.bodies.meshes.mesh_made import extrude, linear
from dolfinx_nts.bodies.motion import BodyMotion, motion_of
from dolfinx_nts.bodies.rigid.rigid import RigidBody
from dolfinx_nts.bodies.slender.beam import Beam
from dolfinx_nts.bodies.slender.director_loads import LineForce, LineMoment, PointForce, PointMoment
from dolfinx_nts.bodies.slender.node_conditions import Clamp
from dolfinx_nts.bodies.slender.section import Circle, Rectangle, Section
from dolfinx_nts.bodies.slender.shell import Shell
from dolfinx_nts.bodies.solid.continuum import Continuum
from dolfinx_nts.bodies.solid.form_body import FormBody
from dolfinx_nts.bodies.solid.materials import MooneyRivlin, NeoHookean, StVenantKirchhoff
from dolfinx_nts.bodies.solid.ogden import Ogden
from dolfinx_nts.bodies.solid.rubber import ArrudaBoyce, Yeoh
from dolfinx_nts.bodies.solid.stress import cauchy_stress, von_mises
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.contact.obstacle_pair import ObstaclePair
from dolfinx_nts.contact.obstacle_surface import ObstacleSurfacePair
from dolfinx_nts.contact.obstacles import Cylinder, Obstacle, Plane, Sphere
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.self_contact import SelfContact
from dolfinx_nts.contact.surface_pair import SurfacePair
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.equations.contact_terms import ContactTerms
from dolfinx_nts.integrators import (
    EnergyMomentum,
    GeneralizedAlpha,
    Integrator,
    Midpoint,
    Newmark,
)
from dolfinx_nts.interaction.coupling import Coupling, Joint, JointCoupling, Slopes, StepWarning
from dolfinx_nts.interaction.elements import Elements, Step
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.interaction.measures import HoldingLaw, Law, Move, Row
from dolfinx_nts.interaction.point_elements import EveryStep, PointElements, PointPart
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.interaction.sketch import Sketch
from dolfinx_nts.joints import (
    Cylindrical,
    Distance,
    Fixed,
    Planar,
    Prismatic,
    Revolute,
    Seam,
    Spherical,
    Tie,
    Universal,
)
from dolfinx_nts.joints.actuators import Thrust, Torque
from dolfinx_nts.joints.cable import Cable
from dolfinx_nts.joints.forces import AboutAxis, BetweenPoints
from dolfinx_nts.joints.laws import JointFriction
from dolfinx_nts.joints.rolling_friction import RollingFriction
from dolfinx_nts.joints.springs import Damper, Spring, TorsionDamper, TorsionSpring
from dolfinx_nts.kernels.nts_element import Gap
from dolfinx_nts.kernels.strain_energy import Isotropic
from dolfinx_nts.run.checkpoint import Checkpoint, restart
from dolfinx_nts.run.equilibrium import equilibrium
from dolfinx_nts.run.run_file import Saved, load
from dolfinx_nts.run.simulate import simulate
from dolfinx_nts.run.solution import Equilibrium, Restart, Solution
from dolfinx_nts.run.step_size import Adapt
from dolfinx_nts.run.stepper import Stepper
from dolfinx_nts.run.writer import Writer
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.state import ContactHistory, State
from dolfinx_nts.system import System
from dolfinx_nts.validation import OutputError, StepFailedError, UserFunctionError

__version__ = version("dolfinx_nts")
__all__ = [
    "AboutAxis",
    "Adapt",
    "ArrudaBoyce",
    "Beam",
    "BetweenPoints",
    "Body",
    "BodyMotion",
    "Cable",
    "Checkpoint",
    "Circle",
    "Clamp",
    "ContactHistory",
    "ContactPair",
    "ContactTerms",
    "Continuum",
    "Coupling",
    "Cylinder",
    "Cylindrical",
    "Damper",
    "Dirichlet",
    "Distance",
    "Elements",
    "EnergyMomentum",
    "Equilibrium",
    "EveryStep",
    "FacetPair",
    "Fixed",
    "FormBody",
    "Gap",
    "GeneralizedAlpha",
    "HoldingLaw",
    "Integrator",
    "Isotropic",
    "Joint",
    "JointCoupling",
    "JointFriction",
    "Law",
    "LineForce",
    "LineMoment",
    "Midpoint",
    "EvaluationPoint",
    "MooneyRivlin",
    "NeoHookean",
    "Move",
    "Newmark",
    "Newton",
    "Obstacle",
    "ObstaclePair",
    "ObstacleSurfacePair",
    "Ogden",
    "OutputError",
    "Part",
    "Planar",
    "Plane",
    "PointElements",
    "PointForce",
    "PointMoment",
    "PointPart",
    "Points",
    "Pressure",
    "Prismatic",
    "Revolute",
    "Rectangle",
    "Restart",
    "RigidBody",
    "RollingFriction",
    "Row",
    "Saved",
    "Seam",
    "SelfContact",
    "Section",
    "Shell",
    "Sketch",
    "Slopes",
    "Solution",
    "Sphere",
    "Spherical",
    "Spring",
    "StVenantKirchhoff",
    "State",
    "Step",
    "StepFailedError",
    "StepWarning",
    "Stepper",
    "Surface",
    "SurfacePair",
    "System",
    "Thrust",
    "Tie",
    "Torque",
    "TorsionDamper",
    "TorsionSpring",
    "Traction",
    "Universal",
    "UserFunctionError",
    "Writer",
    "Yeoh",
    "bodies_from_gmsh",
    "bodies_from_tags",
    "cauchy_stress",
    "equilibrium",
    "extrude",
    "linear",
    "load",
    "motion_of",
    "restart",
    "simulate",
    "von_mises",
]
