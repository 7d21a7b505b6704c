#!/usr/bin/env bash
# check_options.sh NAME COMMAND...: runs COMMAND --check, by which a stage looks at its options and does nothing else. Says in one
# line what is wrong with them; NAME is the setting of make that they come from.
set -uo pipefail
name=$1
shift
said=$("$@" --check 2>&1) && exit 0
said=$(awk '/^(Usage:|For more)/ { exit } NF { $1 = $1; printf "%s%s", between, $0; between = "; " }' <<< "$said")
echo "$name: ${1##*/}: ${said#"${1##*/}: "}" >&2
exit 2
