#!/usr/bin/env bash
# A team's tracking server: MLflow with accounts, on PostgreSQL, with the files of all runs behind it.
#
#   ATLANTIS_DATABASE=postgresql+psycopg2://USER:PASSWORD@/DATABASE?host=/var/run/postgresql docs/server.sh FOLDER [PORT]
#
# FOLDER holds the files and, readable by its owner alone, the secrets: those of the environment (MLFLOW_AUTH_ADMIN_PASSWORD,
# MLFLOW_FLASK_SERVER_SECRET_KEY), else new ones. It listens on 127.0.0.1 only; from elsewhere go through ssh -L, or
# a web server with TLS that names itself in MLFLOW_SERVER_ALLOWED_HOSTS.
set -euo pipefail
umask 077
folder=${1:?FOLDER: where files and secrets are to be} port=${2:-5000}
: "${ATLANTIS_DATABASE:?the address of a PostgreSQL database, as in postgresql+psycopg2://USER:PASSWORD@HOST/DATABASE}"
python=$(command -v "${PYTHON:-python}") || { echo "${PYTHON:-python}: not found" >&2; exit 2; }
python=$(cd "$(dirname "$python")" && pwd)/$(basename "$python")
mkdir -p "$folder/artifacts"
cd "$folder"

if [ ! -e secrets ]; then
    random() { od -An -N24 -tx1 /dev/urandom | tr -d ' \n'; }
    {
        printf 'MLFLOW_AUTH_ADMIN_PASSWORD=%q\n' "${MLFLOW_AUTH_ADMIN_PASSWORD:-$(random)}"
        printf 'MLFLOW_FLASK_SERVER_SECRET_KEY=%q\n' "${MLFLOW_FLASK_SERVER_SECRET_KEY:-$(random)}"
    } > secrets.aside
    mv secrets.aside secrets
fi
given=${MLFLOW_AUTH_ADMIN_PASSWORD-}
set -a; . ./secrets; set +a
[ -z "$given" ] || [ "$given" = "$MLFLOW_AUTH_ADMIN_PASSWORD" ] || echo "the password of $PWD/secrets counts" >&2

# Whoever has an account may write runs; a checked password is believed for a minute, since checking one takes 0.2 s.
# A % is doubled as the file's format wants it.
cat > auth.ini <<EOF
[mlflow]
default_permission = EDIT
database_uri = ${ATLANTIS_DATABASE//%/%%}
admin_username = admin
auth_cache_ttl_seconds = 60
EOF
export MLFLOW_AUTH_CONFIG_PATH=$PWD/auth.ini MLFLOW_BACKEND_STORE_URI=$ATLANTIS_DATABASE
export MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false MLFLOW_DISABLE_TELEMETRY=true

exec "$python" -m mlflow server --app-name basic-auth --host 127.0.0.1 --port "$port" --workers "${WORKERS:-2}" \
    --serve-artifacts --artifacts-destination "$PWD/artifacts"
