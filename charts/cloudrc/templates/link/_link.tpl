{{/* The link container, which shapes what its pod sends. */}}

{{/* Mode of the link. "auto" becomes relay if the namespace refuses NET_ADMIN, or if that is unknown:
     the namespace does not exist yet, or this is `helm template`. An upgrade keeps the mode of the
     install, unless the namespace now forbids it. */}}
{{- define "cloudrc.linkMode" -}}
{{- if ne .Values.link.mode "auto" -}}
{{ .Values.link.mode }}
{{- else -}}
{{- $namespace := lookup "v1" "Namespace" "" .Release.Namespace | default dict -}}
{{- $level := dig "metadata" "labels" "pod-security.kubernetes.io/enforce" "" $namespace -}}
{{- $world := lookup "apps/v1" "Deployment" .Release.Namespace (printf "%s-world" (include "cloudrc.fullname" .)) | default dict -}}
{{- $before := dig "spec" "template" "metadata" "annotations" "cloudrc/link-mode" "" $world -}}
{{- if or (empty $namespace) (has $level (list "baseline" "restricted")) -}}
relay
{{- else if eq $before "relay" -}}
relay
{{- else -}}
auto
{{- end -}}
{{- end -}}
{{- end }}

{{/* The profile as a file: the shipped one, the one in the values, or the experiment's with its
     single values. */}}
{{- define "cloudrc.linkProfile" -}}
{{- $profile := .Values.link.profile -}}
{{- if kindIs "map" $profile -}}
{{ toYaml $profile }}
{{- else if $profile -}}
{{ include "cloudrc.shippedProfile" (dict "root" . "name" $profile "key" "link.profile") }}
{{- else -}}
{{ include "cloudrc.experimentProfile" . }}
{{- end -}}
{{- end }}

{{- define "cloudrc.experimentProfile" -}}
{{- $link := .Values.experiment.link | default dict -}}
{{- $text := "{}" -}}
{{- /* A resolved experiment has all keys of both directions; its profile's name is only a label. */ -}}
{{- if not (and (hasKey ($link.uplink | default dict) "blackouts") (hasKey ($link.downlink | default dict) "blackouts")) -}}
{{- $text = include "cloudrc.shippedProfile" (dict "root" . "name" ($link.profile | default "paper-p2") "key" "experiment.link.profile") -}}
{{- end -}}
{{- if or $link.uplink $link.downlink -}}
{{- $made := fromYaml $text -}}
{{- range $key := list "uplink" "downlink" -}}
{{- $direction := index $made $key | default dict | deepCopy -}}
{{- range $name, $value := index $link $key | default dict -}}
{{- $_ := set $direction $name $value -}}
{{- end -}}
{{- $_ := set $made $key $direction -}}
{{- end -}}
{{- $text = toYaml $made -}}
{{- end -}}
{{ $text }}
{{- end }}

{{- define "cloudrc.shippedProfile" -}}
{{- $text := .root.Files.Get (printf "files/profiles/%s.yaml" .name) -}}
{{- if not $text -}}
{{- $known := list -}}
{{- range $path, $_ := .root.Files.Glob "files/profiles/*.yaml" -}}
{{- $known = append $known (base $path | trimSuffix ".yaml") -}}
{{- end -}}
{{- fail (printf "%s: no profile '%s' ships with the chart; choose one of %s, or write the profile under link.profile" .key .name (join ", " $known)) -}}
{{- end -}}
{{ $text | trimSuffix "\n" }}
{{- end }}

{{/* The files that a profile names, as a mapping of name to text. A missing file fails here, not
     when the containers start. */}}
{{- define "cloudrc.linkFiles" -}}
{{- $found := dict -}}
{{- range $way := list "uplink" "downlink" -}}
{{- range $kind := list "trace" "table" -}}
{{- $name := get (get $.profile $way | default dict) $kind -}}
{{- if $name -}}
{{- if not (hasKey $.root.Values.link.traces $name) -}}
{{- fail (printf "%s: %s.%s names '%s', but link.traces has no such file; add its text there, under a name without folders" $.key $way $kind $name) -}}
{{- end -}}
{{- $_ := set $found $name (get $.root.Values.link.traces $name) -}}
{{- end -}}
{{- end -}}
{{- end -}}
{{ toYaml $found }}
{{- end }}

{{/* A native sidecar: it starts before world or cloud and stops after it. Only this container may have
     NET_ADMIN; it then runs as uid 0, because an added capability has no effect for other users. */}}
{{- define "cloudrc.linkContainer" -}}
{{- $mode := include "cloudrc.linkMode" .root -}}
- name: link
  image: {{ include "cloudrc.image" (dict "root" .root "role" .component) }}
  imagePullPolicy: {{ .root.Values.image.pullPolicy }}
  restartPolicy: Always
  args:
    - link
    - run
    - --config=/etc/cloudrc/experiment.yaml
    - --profile=/etc/cloudrc-link/profile.yaml
    - --direction={{ .direction }}
    - --mode={{ $mode }}
    - --peer={{ include "cloudrc.fullname" .root }}-{{ .peer }}:7400
    - --end=127.0.0.1:7400
    - --listen=127.0.0.1:7401
    - --route=/run/cloudrc/route
    - "--metrics=[::]:9102"
  ports:
    - {name: link-metrics, containerPort: 9102, protocol: TCP}
  {{- include "cloudrc.probes" "link-metrics" | nindent 2 }}
  terminationMessagePolicy: FallbackToLogsOnError
  {{- if eq $mode "relay" }}
  {{- include "cloudrc.containerSecurity" .root | nindent 2 }}
  {{- else }}
  securityContext:
    allowPrivilegeEscalation: false
    readOnlyRootFilesystem: true
    runAsNonRoot: false
    runAsUser: 0
    capabilities:
      drop: [ALL]
      add: [NET_ADMIN]
  {{- end }}
  resources:
    {{- toYaml .root.Values.link.resources | nindent 4 }}
  {{- include "cloudrc.extraEnv" .root.Values.link | nindent 2 }}
  volumeMounts:
    {{- include "cloudrc.experimentMounts" .root | nindent 4 }}
    - {name: link, mountPath: /etc/cloudrc-link, readOnly: true}
    - {name: run, mountPath: /run/cloudrc}
    {{- include "cloudrc.extraMounts" .root.Values.link | nindent 4 }}
{{- end }}
