#!/usr/bin/env bash
# The same with grpcurl (https://github.com/fullstorydev/grpcurl): the service describes itself, no files are needed.
# With TLS and a token leave out -plaintext and add: -cacert ca.pem -H "authorization: Bearer $MAGEX_TOKEN"
set -euo pipefail
at=${1:-127.0.0.1:7100}

grpcurl -plaintext "$at" list
grpcurl -plaintext "$at" grpc.health.v1.Health/Check
grpcurl -plaintext "$at" describe magex.v1.AssignRequest

grpcurl -plaintext -d '{"agents": {"dims": 2, "coordinates": [0, 0, 4, 0]}, "goals": {"dims": 2, "coordinates": [4, 1, 0, 1]}, "agent_ids": ["ada", "bob"], "goal_ids": ["south", "north"], "scheduler": "ASSIGNMENT_METHOD_EXACT"}' "$at" magex.v1.CommanderService/Assign

grpcurl -plaintext -d '{"mission_id": "yard", "agents": [{"id": "ada", "position": [0, 0]}, {"id": "bob", "position": [4, 0]}], "goals": [{"id": "north", "position": [0, 1]}, {"id": "south", "position": [8, 1]}], "switching_cost": 2}' "$at" magex.v1.CommanderService/CreateMission
grpcurl -plaintext -d '{"mission_id": "yard", "agents": [{"id": "ada", "state": "MEMBER_STATE_FAILED"}]}' "$at" magex.v1.CommanderService/UpdateMission
grpcurl -plaintext -d '{"page_size": 10}' "$at" magex.v1.CommanderService/ListAssignments
grpcurl -plaintext -d '{"mission_id": "yard"}' "$at" magex.v1.CommanderService/DeleteMission
# In another terminal, before the update: every change as it happens.
# grpcurl -plaintext -d '{"mission_ids": ["yard"]}' 127.0.0.1:7100 magex.v1.CommanderService/WatchAssignments
