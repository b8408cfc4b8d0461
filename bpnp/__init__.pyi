from .maps.scene_map import SceneMap as SceneMap
from .models.bpnpnet import BPnPNet as BPnPNet
from .models.matcher import Matcher as Matcher
from .search.api import solve as solve
from .search.api import solve_many as solve_many
from .search.find import warm_up as warm_up
from .search.solution import Solution as Solution
from .search.starts import GravityPrior as GravityPrior
from .search.starts import PosePrior as PosePrior
from .search.verify import verify as verify
from .types import Batch as Batch
from .types import Pose as Pose
from .types import Prediction as Prediction
from .types import SolveStats as SolveStats

__version__: str
