#!/usr/bin/env bash
# torch 2.15.0 on a CPU, `with torch.device("meta")` around a model that is built without memory for its weights.
# Input: Ctrl-C (KeyboardInterrupt, in a notebook the end of a cell) while torch.nn.init fills a parameter.
# Expected: KeyboardInterrupt, and outside of the block the default device that was there before.
# Seen: where it comes as torch puts its device mode back (a Python context manager, so between two of its lines; by
#   the clock 1 interruption in 90 of those that come during the initialization), RuntimeError "trying to pop from empty
#   mode stack" instead of KeyboardInterrupt, and from then on every new tensor of the thread is a meta tensor.
# Met when a test that interrupts commands made all tests after it fail. Way round: build the model in a short-lived
#   thread; Python raises KeyboardInterrupt in the main thread alone, and modes belong to a thread.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.15.0 numpy==1.26.4
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import contextlib
import sys
import threading

import torch


def interrupt_at_the_mode_s_return(frame, event, argument):
    """KeyboardInterrupt at the first line of the context manager's end, once."""
    if frame.f_code is contextlib._GeneratorContextManager.__exit__.__code__:
        if frame.f_locals["self"].gen.gi_code.co_name == "_pop_mode_temporarily":
            sys.settrace(None)
            raise KeyboardInterrupt


def build():
    with torch.device("meta"):
        return torch.nn.Linear(2, 2)


def tell(name, block):
    try:
        block()
        ended = "no error"
    except BaseException as error:
        ended = f"{type(error).__name__}: {error}".splitlines()[0]
    sys.settrace(None)
    print(f"{name} | {ended} | a new tensor is on", torch.empty(1).device)


def interrupted():
    sys.settrace(interrupt_at_the_mode_s_return)
    build()


def in_a_thread():
    sys.settrace(interrupt_at_the_mode_s_return)
    thread = threading.Thread(target=build)
    thread.start()
    thread.join()


print("torch", torch.__version__.split("+")[0])
tell("not interrupted", build)
tell("in a thread of its own", in_a_thread)
tell("interrupted", interrupted)
tell("afterwards", build)
PYTHON
diff seen - <<'SEEN'
torch 2.15.0
not interrupted | no error | a new tensor is on cpu
in a thread of its own | no error | a new tensor is on cpu
interrupted | RuntimeError: trying to pop from empty mode stack | a new tensor is on meta
afterwards | no error | a new tensor is on meta
SEEN
