#!/bin/sh
# Run once by the image of PostgreSQL, after it has made the data of a primary.
set -e
echo "host replication all samenet $POSTGRES_HOST_AUTH_METHOD" >> "$PGDATA/pg_hba.conf"
# From its next start on: while the data is made there is no replica that a commit could wait for.
psql -v ON_ERROR_STOP=1 -U "$POSTGRES_USER" -d "$POSTGRES_DB" -c "ALTER SYSTEM SET synchronous_standby_names = 'b'"
