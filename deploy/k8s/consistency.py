"""What no schema says: that names meet, and that every pod keeps to the rules of docs/operations.md.

python3 consistency.py MANIFEST...
"""

import sys

import yaml

WORKLOADS = {"Deployment", "StatefulSet"}


def objects(paths):
    for path in paths:
        with open(path, encoding="utf-8") as file:
            yield path, [o for o in yaml.safe_load_all(file) if o]


def selects(selector, labels):
    return all(labels.get(key) == value for key, value in selector.items())


def problems(everything):
    """Yields what is wrong with one set of objects."""
    by_kind = {}
    for o in everything:
        by_kind.setdefault(o["kind"], []).append(o)
    pods = {w["metadata"]["name"]: w["spec"]["template"] for kind in WORKLOADS for w in by_kind.get(kind, [])}
    # A base names no secrets of its own.
    made = {o["metadata"]["name"] for kind in ("Secret", "ConfigMap") for o in by_kind.get(kind, [])}
    claims = {o["metadata"]["name"] for o in by_kind.get("PersistentVolumeClaim", [])}

    for kind in WORKLOADS:
        for workload in by_kind.get(kind, []):
            name = f"{kind}/{workload['metadata']['name']}"
            template = workload["spec"]["template"]
            spec = template["spec"]
            if not selects(workload["spec"]["selector"]["matchLabels"], template["metadata"]["labels"]):
                yield f"{name}: its selector does not select its own pods"
            if spec["securityContext"].get("runAsNonRoot") is not True:
                yield f"{name}: may run as root"
            if spec["securityContext"]["seccompProfile"]["type"] != "RuntimeDefault":
                yield f"{name}: no seccomp profile"
            if spec.get("automountServiceAccountToken") is not False:
                yield f"{name}: gets a token of the API server, which it does not need"
            mounts = {volume["name"] for volume in spec.get("volumes", [])}
            mounts |= {c["metadata"]["name"] for c in workload["spec"].get("volumeClaimTemplates", [])}
            for volume in spec.get("volumes", []):
                wanted = volume.get("secret", {}).get("secretName") or volume.get("configMap", {}).get("name")
                if wanted and any(o["kind"] == "Secret" for o in everything) and wanted not in made:
                    yield f"{name}: mounts {wanted}, which nothing makes"
                claim = volume.get("persistentVolumeClaim", {}).get("claimName")
                if claim and claim not in claims:
                    yield f"{name}: mounts the claim {claim}, which nothing makes"
            for container in spec["containers"]:
                security = container["securityContext"]
                if security.get("allowPrivilegeEscalation") is not False or security.get("readOnlyRootFilesystem") is not True:
                    yield f"{name}: may write to its root or gain rights"
                if security["capabilities"]["drop"] != ["ALL"]:
                    yield f"{name}: keeps capabilities"
                if not {"requests", "limits"} <= set(container["resources"]):
                    yield f"{name}: requests or limits are missing"
                if "livenessProbe" not in container:
                    yield f"{name}: no liveness probe"
                ports = {port["name"] for port in container["ports"]}
                probe = container["livenessProbe"]["httpGet"]["port"]
                if probe not in ports:
                    yield f"{name}: is probed at {probe}, which is no port of it"
                for mount in container.get("volumeMounts", []):
                    if mount["name"] not in mounts:
                        yield f"{name}: mounts {mount['name']}, which is no volume of it"
                environment = {variable["name"]: variable.get("value", "") for variable in container["env"]}
                if "MAGEX_INSECURE" in environment or any(v.startswith("http://") for v in environment.values()):
                    yield f"{name}: talks without certificates"
                targets = {s["metadata"]["name"]: {p["port"] for p in s["spec"]["ports"]} for s in by_kind.get("Service", [])}
                for variable, value in environment.items():
                    if value.startswith("https://"):
                        host, port = value.removeprefix("https://").split(":")
                        if int(port) not in targets.get(host, set()):
                            yield f"{name}: {variable} is {value}, which no service is"

    for service in by_kind.get("Service", []):
        name = service["metadata"]["name"]
        chosen = [t for t in pods.values() if selects(service["spec"]["selector"], t["metadata"]["labels"])]
        if len(chosen) != 1:
            yield f"Service/{name}: selects {len(chosen)} workloads"
        for template in chosen:
            ports = {p["name"] for c in template["spec"]["containers"] for p in c["ports"]}
            for port in service["spec"]["ports"]:
                if port["targetPort"] not in ports:
                    yield f"Service/{name}: its port {port['targetPort']} is no port of its pods"
    for scaler in by_kind.get("HorizontalPodAutoscaler", []):
        target = scaler["spec"]["scaleTargetRef"]["name"]
        owner = [d for d in by_kind.get("Deployment", []) if d["metadata"]["name"] == target]
        if not owner or "replicas" in owner[0]["spec"]:
            yield f"HorizontalPodAutoscaler/{scaler['metadata']['name']}: {target} is not there, or names its own replicas"
    policies = by_kind.get("NetworkPolicy", [])
    deny = [p for p in policies if p["spec"]["podSelector"] == {} and set(p["spec"]["policyTypes"]) == {"Ingress", "Egress"}
            and not p["spec"].get("ingress") and not p["spec"].get("egress")]
    if not deny:
        yield "NetworkPolicy: nothing denies what is not named"
    labels = [t["metadata"]["labels"] for t in pods.values()]
    for policy in policies + by_kind.get("PodDisruptionBudget", []):
        selector = policy["spec"].get("podSelector", policy["spec"].get("selector", {})).get("matchLabels", {})
        if not any(selects(selector, one) for one in labels):
            yield f"{policy['kind']}/{policy['metadata']['name']}: selects no pod"


def main(paths):
    sets = list(objects(paths))
    # Files that are no rendered whole belong together.
    if not any("base.yaml" in path or "overlay-" in path for path, _ in sets):
        sets = [("base", [o for _, some in sets for o in some])]
    found = [f"{path}: {problem}" for path, some in sets for problem in problems(some)]
    for line in found:
        print(line, file=sys.stderr)
    if found:
        return 1
    print(f"kubernetes: {sum(len(some) for _, some in sets)} objects fit the schemas and each other")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
