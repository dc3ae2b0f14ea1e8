#!/usr/bin/env bash
# Measure on one NVIDIA GPU: benchmarks, two trainings side by side, and experiments/paper.py.
#
#     benchmarks/gpu.sh [--dry-run] [PART ...]
#
# Parts: install train infer frame sim seeds paper; without names all of them, in this order.
# Benchmarks begin anew after a stop, so they come first. `paper` takes the time that is left, and
# continues if it is run again. At most MINUTES (25) pass. Results go to runs/gpu, and copies to the
# folder OUT if it is set: commands name no other place, so docs/keep.py takes their files.
set -u
cd "$(dirname "$0")/.." || exit 2

PARTS="install train infer frame sim seeds paper"
TO=runs/gpu
END=$((SECONDS + 60 * ${MINUTES:-25} - 30)) # the summary takes the last half minute
REST=100000 # seconds: until END
PATH=$PWD/.venv/bin:$PATH
export PATH JAX_PLATFORMS=cuda,cpu # a GPU that cannot be opened is an error
dry=false
checked=false
child=
failed=()

# step NAME SECONDS COMMAND...: run a command within its time, and not beyond END
step() {
    local name=$1 limit=$2 left=$((END - SECONDS)) start=$SECONDS code
    shift 2
    if $dry; then
        printf '%s:' "$name"
        printf ' %q' "$@"
        echo
        return
    fi
    limit=$((limit < left ? limit : left))
    if [ "$limit" -le 0 ]; then
        failed+=("$name: no time is left")
        return 1
    fi
    timeout -k 20 "$limit" "$@" >"$TO/$name.log" 2>&1 <&0 & # so that a signal ends the wait
    child=$!
    wait "$child"
    code=$?
    child=
    echo "$name: $((SECONDS - start)) s, exit code $code"
    printf '%s\t%s\t%s\n' "$name" "$((SECONDS - start))" "$code" >>"$TO/steps.tsv"
    case $code in
        0) ;;
        124 | 137) failed+=("$name: stopped after $limit s; run it again") ;;
        *) failed+=("$name: exit code $code; see $TO/$name.log") ;;
    esac
    copy
    return "$code"
}

copy() {
    [ -z "${OUT:-}" ] || { mkdir -p "$OUT" && cp "$TO"/*.* "$OUT"; }
}

finish() {
    [ -z "$child" ] || { kill "$child" && wait "$child"; }
    # without a GPU, too: then the file says so
    $dry || { JAX_PLATFORMS='' python -m benchmarks.gpu_summary "$TO" && copy; } ||
        failed+=("summary: not written")
    if [ ${#failed[@]} -gt 0 ]; then
        printf 'failed: %s\n' "${failed[@]}" >&2
        exit 1
    fi
    exit "${1:-0}"
}

bench() { # NAME SECONDS ARGUMENT...
    step "$1" "$2" python -m benchmarks "${@:3}" --json "$TO/$1.json"
}

install() {
    local driver wanted='.[gpu]'
    driver=$(nvidia-smi --query-gpu=driver_version --format=csv,noheader 2>/dev/null | head -n 1)
    driver=${driver%%.*}
    [ "${driver:-580}" -ge 580 ] || wanted='jax[cuda12]' # older drivers lack CUDA 13
    step venv 60 "${PYTHON:-python3}" -m venv .venv &&
        step install 420 python -m pip install --disable-pip-version-check --quiet \
            --constraint constraints.txt --editable . "$wanted"
}

# End unless JAX sees a GPU: else the CPU would be measured.
check() {
    checked=true
    step check 120 python -c 'import jax; print(jax.devices("gpu"))' && return
    failed+=("JAX sees no GPU: install an NVIDIA driver, 580 or later for CUDA 13 or 525 for CUDA \
12; then run benchmarks/gpu.sh install")
    finish
}

# The network is as large as others, the data few. The first sweep makes data and programs.
seeds() {
    local -x XLA_PYTHON_CLIENT_MEM_FRACTION=0.2 # each process takes this share of the memory
    local workers short=(
        jaxunshear sweep experiments/tiny.py --networks disentangled
        --unshear.widths "32,64,64,128,256" --train.batch 32 --train.epochs 6000
        --train.validate_every 3000 --out "$TO/sweeps"
    )
    $dry || rm -rf "$TO/sweeps" # a finished row would take no time
    step seeds_first 200 "${short[@]}" --seeds 2 --name first
    for workers in 1 2; do
        step "seeds_by_$workers" 300 xargs -P "$workers" -I '{}' "${short[@]}" --seeds '{}' \
            --name "by_${workers}_{}" --json "$TO/seed_by_${workers}_{}.json" <<<$'0\n1'
    done
}

paper() {
    local paper=(experiments/paper.py --out "$TO") network
    step paper_data "$REST" jaxunshear data "${paper[@]}" || return
    for network in posenet disentangled entangled; do # the shortest first
        step "paper_$network" "$REST" jaxunshear train "${paper[@]}" --network "$network" || return
    done
    step paper_run "$REST" jaxunshear run "${paper[@]}" || return
    $dry || cp "$TO/paper/results.json" "$TO/paper.json"
}

run_part() {
    case $1 in
        install) install ;;
        train) bench train 300 train ;;
        infer) bench infer 240 infer ;;
        frame) bench frame 240 frame ;;
        sim)
            bench sim_64 240 sim --level auto --batch 64
            bench sim_256 150 sim --level auto --batch 256
            ;;
        seeds) seeds ;;
        paper) paper ;;
    esac
}

chosen=()
for word; do
    case " $PARTS --dry-run " in
        *" $word "*) if [ "$word" = --dry-run ]; then dry=true; else chosen+=("$word"); fi ;;
        *)
            echo "PART = $word: must be one of $PARTS, or --dry-run" >&2
            exit 2
            ;;
    esac
done
[ ${#chosen[@]} -gt 0 ] || read -ra chosen <<<"$PARTS"
trap 'failed+=("stopped by a signal"); finish' INT TERM
$dry || mkdir -p "$TO"
for part in "${chosen[@]}"; do
    [ "$part" = install ] || $checked || check
    run_part "$part"
done
finish
