{{/* Values of an earlier install. `helm upgrade --reuse-values` leaves out what has been added to
     values.yaml since; both kinds of upgrade bring what has gone. */}}

{{/* Give the defaults to keys that were added to the chart. Each template begins with this: Helm renders
     them in an order of its own, with the same values. */}}
{{- define "cloudrc.addDefaults" -}}
{{- if not (hasKey .Values "defaultsAdded") -}}
{{- include "cloudrc.wholeNumbers" .Values -}}
{{- include "cloudrc.addKeys" (dict "to" .Values "from" (.Files.Get "files/added.yaml" | fromYaml)) -}}
{{- $_ := set .Values "defaultsAdded" true -}}
{{- end -}}
{{- end }}

{{/* Helm reads the numbers of a file as floating point, and would print 2147483648 as 2.147483648e+09.
     toYaml, which prints lists, does not. */}}
{{- define "cloudrc.wholeNumbers" -}}
{{- range $key, $value := . -}}
{{- if kindIs "map" $value -}}
{{- include "cloudrc.wholeNumbers" $value -}}
{{- else if kindIs "float64" $value -}}
{{- if eq $value (floor $value) -}}
{{- $_ := set $ $key (int64 $value) -}}
{{- end -}}
{{- end -}}
{{- end -}}
{{- end }}

{{/* Amounts of resources are not added one by one: null takes one out, such as a limit of cpu. */}}
{{- define "cloudrc.addKeys" -}}
{{- $to := .to -}}
{{- range $key, $default := .from -}}
{{- if not (hasKey $to $key) -}}
{{- $_ := set $to $key $default -}}
{{- else if and (kindIs "map" $default) (kindIs "map" (get $to $key)) (ne $key "resources") -}}
{{- include "cloudrc.addKeys" (dict "to" (get $to $key) "from" $default) -}}
{{- end -}}
{{- end -}}
{{- end }}

{{/* Take values that have gone out of a copy of the values; name each one that is there, with what
     takes its place. Argument: (dict "root" $ "values" COPY). */}}
{{- define "cloudrc.takeRetired" -}}
{{- $values := .values -}}
{{- range $path, $instead := .root.Files.Get "files/retired.yaml" | fromYaml -}}
{{- $keys := splitList "." $path -}}
{{- $part := $values -}}
{{- range initial $keys -}}
{{- $part = kindIs "map" $part | ternary (get (kindIs "map" $part | ternary $part dict) .) "" -}}
{{- end -}}
{{- if and (kindIs "map" $part) (hasKey (kindIs "map" $part | ternary $part dict) (last $keys)) -}}
{{- $value := get $part (last $keys) -}}
{{- $_ := unset $part (last $keys) -}}
{{- if $value }}
- {{ $path }}: {{ $instead }} takes its place
{{- end -}}
{{- end -}}
{{- end -}}
{{- end }}
