"""Serve what people ask of the places: add, save, load, look again, reset."""

from typing import TYPE_CHECKING

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_srvs.srv import Trigger

from lcd_common.errors import LocalizationError
from lcd_common.nodes.awaited import Awaited
from lcd_msgs.srv import LoadMap, SaveMap
from uncertain_place_recognition.place_recognizer import PlaceRecognizer

if TYPE_CHECKING:
    from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode


class PlaceServices:
    """Offer the services of a place recognition node under its own name."""

    def __init__(self, node: 'PlaceRecognitionNode', *, threaded: bool) -> None:
        """Offer them; threaded, places are written beside the callbacks."""
        self._node = node
        self._awaited = Awaited(node, threaded=threaded)
        group = MutuallyExclusiveCallbackGroup()
        for kind, name, callback in (
            (Trigger, '~/add_place', self.on_add_place),
            (SaveMap, '~/save_map', self.on_save_map),
            (LoadMap, '~/load_map', self.on_load_map),
            (Trigger, '~/relocalize', self.on_relocalize),
            (Trigger, '~/reset', self.on_reset),
        ):
            node.create_service(kind, name, callback, callback_group=group)

    def on_add_place(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Let the next scan be a place."""
        self._node.add_next()
        response.success, response.message = True, 'the next scan will be a place'
        return response

    async def on_save_map(
        self, request: SaveMap.Request, response: SaveMap.Response
    ) -> SaveMap.Response:
        """Write the places as they are now."""
        recognizer = self._node.recognizer
        if not len(recognizer):
            response.message = 'there is no place yet: nothing was saved'
        else:
            response.success, response.message = await self._awaited.answer(
                lambda: _saved(recognizer, request.path),
                f'{request.path}: the places could not be saved',
            )
        return response

    def on_load_map(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        """Replace the places by saved ones, and begin a drive in them."""
        if not request.path:
            response.message = 'expected the folder of saved places, got an empty path'
            return response
        try:
            self._node.restart(request.path)
        except LocalizationError as error:
            response.message = str(error)
            return response
        response.success = True
        response.message = f'{len(self._node.recognizer)} places loaded from {request.path}'
        return response

    def on_relocalize(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Look for the vehicle once more."""
        if not len(self._node.recognizer):
            response.message = 'there is no place to be found at: load a map first'
            return response
        self._node.look_again()
        response.success, response.message = True, 'looking for the vehicle in the map'
        return response

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget all places."""
        self._node.start_over()
        response.success, response.message = True, 'there are no places'
        return response


def _saved(recognizer: PlaceRecognizer, path: str) -> str:
    folder = recognizer.save(path)
    return f'{len(recognizer)} places saved in {folder}'
