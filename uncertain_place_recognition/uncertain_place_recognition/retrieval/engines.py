"""Choose what searches the places."""

from typing import Any

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from uncertain_place_recognition.retrieval.exact_index import CompactIndex, ExactIndex
from uncertain_place_recognition.retrieval.faiss_index import FaissConfig, FaissIndex
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.qdrant_index import (
    QdrantConfig,
    QdrantIndex,
    open_client,
)
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex


@config
class IndexConfig:
    """What searches the places."""

    engine: str = setting(
        'exact',
        'what compares: all places; all, with 8 bits first; a part of many; the map of a fleet',
        choices=('exact', 'compact', 'faiss', 'qdrant'),
    )


class IndexMaker:
    """Make empty indices of the chosen engine; those of a shared map have one connection."""

    def __init__(
        self,
        settings: IndexConfig | None = None,
        faiss: FaissConfig | None = None,
        qdrant: QdrantConfig | None = None,
        *,
        client: Any = None,
    ) -> None:
        """Choose an engine; `client` is a connection of qdrant-client that is open already."""
        self.settings = settings or IndexConfig()
        self._faiss, self._qdrant = faiss or FaissConfig(), qdrant or QdrantConfig()
        self._client = client

    def make(
        self, length: int, metric: str, window: InsertionConfig, ensemble: str
    ) -> WindowedIndex:
        """Return an index without places of this vehicle.

        Args:
            length: of a descriptor.
            metric: how places are ranked.
            window: how long new ones wait.
            ensemble: hash of the weights, for a map that several may share.

        Raises:
            ConfigError: the engine cannot do that.
            MissingPackageError: its package is not installed.
            MapError: the shared map does not answer, or is of another kind.
        """
        engine = self.settings.engine
        if engine == 'faiss':
            return FaissIndex(length, metric, window, self._faiss)
        if engine == 'qdrant':
            return self._shared(length, metric, window, ensemble)
        if engine == 'exact':
            return ExactIndex(length, metric, window)
        if metric != 'cosine':
            raise ConfigError(
                f'engine compact compares by cosine alone, the calibration ranks by {metric}: '
                'choose the engine exact'
            )
        return CompactIndex(length, window)

    def _shared(
        self, length: int, metric: str, window: InsertionConfig, ensemble: str
    ) -> QdrantIndex:
        if self._client is None and (self._qdrant.url or self._qdrant.folder):
            self._client = open_client(self._qdrant)  # a folder cannot be opened twice
        return QdrantIndex(
            length, metric, window, self._qdrant, ensemble=ensemble, client=self._client
        )
