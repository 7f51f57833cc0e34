"""Work without processes."""

import pickle
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any


class Here(Executor):
    """Does its work at once in this process, pickled on its way there and back as if there were another one."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        work = pickle.loads(pickle.dumps((fn, args, kwargs)))
        try:
            future.set_result(pickle.loads(pickle.dumps(work[0](*work[1], **work[2]))))
        except Exception as error:
            future.set_exception(pickle.loads(pickle.dumps(error)))
        return future
