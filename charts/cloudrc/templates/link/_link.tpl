{{/* The link container: it shapes what its pod sends. */}}

{{/* How it shapes. auto is relay where NET_ADMIN would be refused, or where that cannot be known:
     the namespace is not there yet, or this is `helm template`. An upgrade keeps what the first
     install has chosen, unless the namespace forbids it since. */}}
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

{{/* The profile as a file: a shipped one as it is, else as written in the values, else the
     experiment's with its single values over it. */}}
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
{{- /* A resolved experiment spells both directions out; its profile's name is only a label. */ -}}
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
{{- fail (printf "%s: no profile '%s' ships with the chart; choose one of %s, or write it out under link.profile" .key .name (join ", " $known)) -}}
{{- end -}}
{{ $text | trimSuffix "\n" }}
{{- end }}

{{/* The files that a profile names, as a mapping of name to text. One that is not there would be
     refused by the containers when they start. */}}
{{- define "cloudrc.linkFiles" -}}
{{- $found := dict -}}
{{- range $way := list "uplink" "downlink" -}}
{{- range $kind := list "trace" "table" -}}
{{- $name := get (get $.profile $way | default dict) $kind -}}
{{- if $name -}}
{{- if not (hasKey $.root.Values.link.traces $name) -}}
{{- fail (printf "%s: %s.%s names '%s', and link.traces has no such file; put its text there, under a name without folders" $.key $way $kind $name) -}}
{{- end -}}
{{- $_ := set $found $name (get $.root.Values.link.traces $name) -}}
{{- end -}}
{{- end -}}
{{- end -}}
{{ toYaml $found }}
{{- end }}

{{/* A native sidecar: it starts before the ends and stops after them. The only container that may
     have NET_ADMIN, and then uid 0, since an added capability is not effective for another. */}}
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
    - --listen=127.0.0.1:7401
    - --route=/run/cloudrc/route
    - --metrics=0.0.0.0:9102
  ports:
    - {name: link-metrics, containerPort: 9102, protocol: TCP}
  {{- include "cloudrc.probes" "link-metrics" | nindent 2 }}
  terminationMessagePolicy: FallbackToLogsOnError
  securityContext:
    {{- if eq $mode "relay" }}
    {{- include "cloudrc.containerSecurity" . | nindent 4 }}
    {{- else }}
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
  volumeMounts:
    - {name: experiment, mountPath: /etc/cloudrc, readOnly: true}
    - {name: link, mountPath: /etc/cloudrc-link, readOnly: true}
    - {name: run, mountPath: /run/cloudrc}
{{- end }}
