#!/usr/bin/env bash
# grpcio 1.85.3: when the head (initial metadata) of a streaming answer is sent.
#
# Expected: the head goes out when the handler of a stream-stream call begins, as in other implementations, so that a client may wait for
# it before it sends its first request.
# Seen: it waits for the handler's first message. A client that awaits the head first (tonic's generated clients do: the call returns a
# stream only then) and a handler that waits for the first request wait for each other for ever; with send_initial_metadata(()) at the
# beginning of the handler the head comes at once.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check --only-binary=:all: grpcio==1.85.3
cat > head.py <<'PYTHON'
import queue, threading
from concurrent import futures
import grpc

def serve(at_once):
    def handler(requests, context):
        if at_once:
            context.send_initial_metadata(())
        for request in requests:
            yield request
    method = grpc.stream_stream_rpc_method_handler(handler)
    server = grpc.server(futures.ThreadPoolExecutor(2))
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("test.Echo", {"Run": method}),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    return server, port

for at_once in (False, True):
    server, port = serve(at_once)
    requests, heads = queue.SimpleQueue(), queue.SimpleQueue()
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        call = channel.stream_stream("/test.Echo/Run")(iter(requests.get, None))
        threading.Thread(target=lambda: heads.put(call.initial_metadata()), daemon=True).start()
        def head_within(seconds):
            try:
                heads.get(timeout=seconds)
                return True
            except queue.Empty:
                return False
        before = head_within(3)
        requests.put(b"first")
        next(call)
        print(f"send_initial_metadata {at_once}: head before the first request {before}, after it {before or head_within(3)}")
        requests.put(None)
    server.stop(None)
PYTHON
venv/bin/python head.py | tee seen
diff seen - <<'SEEN' && echo "as before"
send_initial_metadata False: head before the first request False, after it True
send_initial_metadata True: head before the first request True, after it True
SEEN
