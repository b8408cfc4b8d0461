from .figures import (
    plot_image as plot_image,
)
from .figures import (
    plot_problem as plot_problem,
)
from .figures import (
    plot_residuals as plot_residuals,
)
from .figures import (
    plot_scene as plot_scene,
)
from .figures import (
    recall_curve as recall_curve,
)
from .page.write import write_page as write_page
from .points import read_points as read_points
from .results import (
    ProblemRow as ProblemRow,
)
from .results import (
    Results as Results,
)
from .results import (
    read_results as read_results,
)
from .results import (
    write_results as write_results,
)
from .runs import table as table
