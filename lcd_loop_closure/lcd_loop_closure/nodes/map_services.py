"""Serve what people ask of a map: save, load, pause, reset, add or remove a loop."""

from typing import TYPE_CHECKING

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_srvs.srv import SetBool, Trigger

from lcd_common.errors import DataError, MapError
from lcd_common.nodes import messages
from lcd_common.nodes.awaited import Awaited
from lcd_loop_closure.map_store import SavedMap, save_map
from lcd_msgs.srv import AddLoop, LoadMap, RemoveLoop, SaveMap

if TYPE_CHECKING:
    from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode


class MapServices:
    """Offer the services of a pose graph node under its own name."""

    def __init__(self, node: 'PoseGraphNode', *, threaded: bool) -> None:
        """Offer them; threaded, a map is written beside the callbacks."""
        self._node = node
        self._awaited = Awaited(node, threaded=threaded)
        # A group of their own: odometry goes on while a save is awaited.
        group = MutuallyExclusiveCallbackGroup()
        for kind, name, callback in (
            (SaveMap, '~/save_map', self.on_save_map),
            (LoadMap, '~/load_map', self.on_load_map),
            (SetBool, '~/pause', self.on_pause),
            (Trigger, '~/reset', self.on_reset),
            (AddLoop, '~/add_loop', self.on_add_loop),
            (RemoveLoop, '~/remove_loop', self.on_remove_loop),
        ):
            node.create_service(kind, name, callback, callback_group=group)

    async def on_save_map(
        self, request: SaveMap.Request, response: SaveMap.Response
    ) -> SaveMap.Response:
        """Write the map as it is now; it may grow meanwhile."""
        saved = self._node.map.saved()
        if not len(saved.graph):
            response.message = 'there is no keyframe yet: nothing was saved'
        else:
            response.success, response.message = await self._awaited.answer(
                lambda: _saved(saved, request.path), f'{request.path}: the map could not be saved'
            )
        return response

    def on_load_map(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        """Replace the map by a saved one; the next keyframes are a new session in it."""
        if not request.path:
            response.message = 'expected the folder of a saved map, got an empty path'
            return response
        try:
            self._node.restart(request.path)
        except MapError as error:
            response.message = str(error)
            return response
        response.success = True
        response.message = f'{len(self._node.map)} keyframes loaded from {request.path}'
        return response

    def on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Stop or go on taking keyframes and loops; map -> odom goes on."""
        self._node.paused = request.data
        response.success = True
        response.message = 'paused: the map stays as it is' if request.data else 'mapping goes on'
        return response

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget the map."""
        self._node.restart('')
        response.success, response.message = True, 'the map is empty'
        return response

    def on_add_loop(self, request: AddLoop.Request, response: AddLoop.Response) -> AddLoop.Response:
        """Put a loop in by hand; it is never judged."""
        ids = f'{request.match_id} - {request.query_id}'
        try:
            T_match_query, covariance = messages.from_pose_with_covariance(request.transform)
            if covariance is None:
                raise DataError('a loop by hand needs a positive definite covariance, got zeros')
            self._node.map.add_loop_by_hand(
                request.match_id, request.query_id, T_match_query, covariance
            )
        except DataError as error:
            response.message = str(error)
            return response
        self._node.update()
        response.success, response.message = True, f'loop {ids} is in the graph'
        return response

    def on_remove_loop(
        self, request: RemoveLoop.Request, response: RemoveLoop.Response
    ) -> RemoveLoop.Response:
        """Take a loop out by hand, for good."""
        ids = f'{request.match_id} - {request.query_id}'
        response.success = self._node.map.graph.remove_loop(request.match_id, request.query_id)
        if response.success:
            self._node.update()
            response.message = f'loop {ids} is out of the graph'
        else:
            response.message = f'there is no loop {ids}'
        return response


def _saved(saved: SavedMap, path: str) -> str:
    folder = save_map(saved, path)
    return f'{len(saved.graph)} keyframes saved in {folder}'
