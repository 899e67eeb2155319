"""The process in which an entry point's controller runs: `python -m skysim.dynamics.controller_host NAME`.

It speaks the protocol of docs/howto/controller.md.
"""

import sys
from functools import partial
from typing import IO

from skysim.core.plugins import Respond, describe_error, serve
from skysim.core.types import Record
from skysim.dynamics.controllers import (
    CONTROLLERS,
    ControllerInput,
    ControllerSetup,
    build_law,
    check_torque,
)


def create(name: str, tree: Record) -> Respond:
    """The function with which `serve` answers a control period: the torque, or a status if the controller fails."""
    setup = ControllerSetup.of_tree(tree)
    law = build_law(CONTROLLERS.entry_points()[name].load(), setup)

    def respond(inputs: Record, _: IO[bytes]) -> Record:
        try:
            torque_nm = check_torque(law(ControllerInput.of_tree(inputs)), setup.authority_nm)
        except Exception as error:
            return {"tick": inputs["tick"], "status": describe_error(error)}
        return {"tick": inputs["tick"], "torque_nm": torque_nm.tolist()}

    return respond


if __name__ == "__main__":
    serve(partial(create, sys.argv[1]))
