#!/usr/bin/env bash
# The Kubernetes side of pipelines/profiles/kubernetes: Snakemake's cluster-generic executor calls it.
#   kubernetes_job.sh submit THREADS MB MINUTES SCRIPT  makes a Job that runs SCRIPT in this folder; prints its name
#   kubernetes_job.sh status NAME                        success, failed or running
#   kubernetes_job.sh cancel NAME...
# From the environment: CAGS_IMAGE (container image with bash, make, Python and Snakemake), CAGS_CLAIM (volume claim that holds
# this folder, the data and OUT), CAGS_MOUNT (where it is mounted, the same path everywhere).
set -euo pipefail
case ${1-} in
  submit)
    [ $# = 5 ] || { echo "usage: kubernetes_job.sh submit THREADS MB MINUTES SCRIPT" >&2; exit 2; }
    : "${CAGS_IMAGE:?container image}" "${CAGS_CLAIM:?volume claim}" "${CAGS_MOUNT:?where it is mounted}"
    kubectl create -o name -f - << MANIFEST
apiVersion: batch/v1
kind: Job
metadata:
  generateName: cags-
spec:
  backoffLimit: 0
  activeDeadlineSeconds: $(($4 * 60))
  ttlSecondsAfterFinished: 86400
  template:
    spec:
      restartPolicy: Never
      containers:
        - name: stage
          image: "$CAGS_IMAGE"
          workingDir: "$PWD"
          command: ["bash", "$5"]
          resources:
            requests: {cpu: "$2", memory: "${3}Mi"}
            limits: {memory: "${3}Mi"}
          volumeMounts:
            - {name: data, mountPath: "$CAGS_MOUNT"}
      volumes:
        - name: data
          persistentVolumeClaim: {claimName: "$CAGS_CLAIM"}
MANIFEST
    ;;
  status)
    case $(kubectl get "$2" -o 'jsonpath={.status.succeeded}/{.status.failed}') in
      1/*) echo success ;;
      /) echo running ;;
      *) echo failed ;;
    esac
    ;;
  cancel) shift; kubectl delete "$@" ;;
  *) echo "usage: kubernetes_job.sh submit|status|cancel ..." >&2; exit 2 ;;
esac
