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
{{- $world := lookup "apps/v1" (include "cloudrc.isFleet" . | empty | ternary "Deployment" "StatefulSet") .Release.Namespace (printf "%s-world" (include "cloudrc.fullname" .)) | default dict -}}
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

{{/* Text of the shipped profile NAME. Argument: (dict "root" $ "name" NAME "key" KEY-IN-THE-VALUES). */}}
{{- define "cloudrc.shippedProfile" -}}
{{- $text := .root.Files.Get (printf "files/profiles/%s.yaml" .name) -}}
{{- if not $text -}}
{{- $known := list -}}
{{- range $path, $_ := .root.Files.Glob "files/profiles/*.yaml" -}}
{{- $known = append $known (base $path | trimSuffix ".yaml") -}}
{{- end -}}
{{- fail (printf "%s: no profile '%s' ships with the chart; choose one of %s, or write the profile under link.profile" .key .name (join ", " $known)) -}}
{{- end -}}
{{ $text }}
{{- end }}

{{/* Fails if a link names a file that link.traces lacks: here, not when the containers start.
     Argument: (dict "root" $ "link" LINK-OR-PROFILE "key" KEY-IN-THE-VALUES). */}}
{{- define "cloudrc.checkTraces" -}}
{{- range $way := list "uplink" "downlink" -}}
{{- range $kind := list "trace" "table" -}}
{{- $name := get (get $.link $way | default dict) $kind -}}
{{- if and $name (not (hasKey $.root.Values.link.traces $name)) -}}
{{- fail (printf "%s: %s.%s names '%s', but link.traces has no such file; add its text there, under a name without folders" $.key $way $kind $name) -}}
{{- end -}}
{{- end -}}
{{- end -}}
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
    - --peer={{ include "cloudrc.hostOf" (dict "root" .root "component" .peer "number" "$(ROBOT)") }}:7400
    {{- if include "cloudrc.isFleet" .root }}
    - --robot=$(ROBOT)
    {{- end }}
    - --end=127.0.0.1:7400
    - --listen=127.0.0.1:7401
    - --route=/run/cloudrc/route
    - --control=/run/cloudrc/link.sock
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
  {{- include "cloudrc.env" (list .root .root.Values.link) | nindent 2 }}
  volumeMounts:
    {{- include "cloudrc.experimentMounts" .root | nindent 4 }}
    - {name: link, mountPath: /etc/cloudrc-link, readOnly: true}
    - {name: run, mountPath: /run/cloudrc}
    {{- include "cloudrc.extraMounts" .root.Values.link | nindent 4 }}
{{- end }}
