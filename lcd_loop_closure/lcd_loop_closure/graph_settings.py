"""Group the settings of a pose graph, and make graphs by them."""

from dataclasses import dataclass, field

from lcd_loop_closure.admission import PoseGraphConfig
from lcd_loop_closure.gnss import GnssConfig
from lcd_loop_closure.graph_noise import GraphNoiseConfig
from lcd_loop_closure.graph_snapshot import GraphSnapshot
from lcd_loop_closure.incremental_solver import IncrementalConfig
from lcd_loop_closure.pose_graph import PoseGraph


@dataclass(frozen=True)
class GraphSettings:
    """Settings of the graph and of its parts."""

    graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    noise: GraphNoiseConfig = field(default_factory=GraphNoiseConfig)
    incremental: IncrementalConfig = field(default_factory=IncrementalConfig)
    gnss: GnssConfig = field(default_factory=GnssConfig)

    def make(self) -> PoseGraph:
        """Make an empty graph."""
        return PoseGraph(self.graph, self.noise, self.incremental, self.gnss)

    def restore(self, snapshot: GraphSnapshot) -> PoseGraph:
        """Make a graph that goes on where a snapshot was taken."""
        return PoseGraph.restore(snapshot, self.graph, self.noise, self.incremental, self.gnss)
