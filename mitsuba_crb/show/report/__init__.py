"""Pages of HTML that need nothing else, made from the documents of a run and its pictures."""

from .bound import write_bound_report as write_bound_report
from .field import write_field_report as write_field_report
from .page import Origin as Origin
from .page import plotly_library as plotly_library
from .plan import write_next_views_report as write_next_views_report
from .plan import write_path_report as write_path_report
from .poses import write_poses_report as write_poses_report
from .team import write_fusion_report as write_fusion_report
from .team import write_selection_report as write_selection_report
from .trials import write_validation_report as write_validation_report
